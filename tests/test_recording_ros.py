"""Bags of ROS 1 and 2 and MCAP hold the same motion, as poses, transforms and joint states."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from parts import load_parts
from recording_files import POSES, TIMES, declared, poses_in, same

from koopdqn.app import api
from koopdqn.demonstrations.recordings.load import load
from koopdqn.errors import BadInputError

pytest.importorskip("rosbags")

from rosbags.rosbag1 import Writer as Writer1  # after the skip
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

START = 1_700_000_000_000_000_000
STAMPS = [START + round(1e9 * time) for time in TIMES]


class Bag:
    """Messages of one ROS version, and a bag of them."""

    def __init__(self, kind: str, path: Path) -> None:
        self.kind = kind
        self.store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
        if kind == "ros1":
            content = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(content, "tf2_msgs/msg/TFMessage"))
        self.path = path / ("log.bag" if kind == "ros1" else "log")
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        self.writer: Any = (
            Writer1(self.path) if kind == "ros1" else Writer2(self.path, version=9, storage_plugin=plugin)
        )

    def make(self, name: str, *fields: Any) -> Any:
        return self.store.types[name](*fields)

    def header(self, stamp: int, frame: str) -> Any:
        time = self.make("builtin_interfaces/msg/Time", stamp // 10**9, stamp % 10**9)
        own = (0,) if self.kind == "ros1" else ()
        return self.make("std_msgs/msg/Header", *own, time, frame)

    def write(self, topic: str, kind: str, messages: list[Any], logged: list[int] = STAMPS) -> None:
        known = {"typestore": self.store}
        connection = self.writer.add_connection(topic, kind, **known)
        for stamp, message in zip(logged, messages, strict=True):
            raw = (
                self.store.serialize_ros1(message, kind)
                if self.kind == "ros1"
                else self.store.serialize_cdr(message, kind)
            )
            self.writer.write(connection, stamp, bytes(raw))

    def poses(self, values: np.ndarray) -> list[Any]:
        point = "geometry_msgs/msg/Point"
        turn = "geometry_msgs/msg/Quaternion"
        return [
            self.make("geometry_msgs/msg/Pose", self.make(point, *row[:3]), self.make(turn, *row[4:], row[3]))
            for row in values.tolist()
        ]


KINDS = ["ros1", "ros2", "mcap"]


@pytest.mark.parametrize("kind", KINDS)
def test_stamped_poses(tmp_path: Path, kind: str) -> None:
    bag = Bag(kind, tmp_path)
    with bag.writer:
        stamped = "geometry_msgs/msg/PoseStamped"
        rows = zip(STAMPS, bag.poses(POSES), strict=True)
        bag.write("/tool", stamped, [bag.make(stamped, bag.header(stamp, "base"), each) for stamp, each in rows])
    (item,) = load(bag.path, declared({}), None).items
    same(item.poses, POSES)
    np.testing.assert_allclose(item.times, TIMES, atol=1e-6)
    if kind == "mcap":
        (found,) = poses_in(next(bag.path.glob("*.mcap")))
        same(found, POSES)


@pytest.mark.parametrize("kind", KINDS)
def test_of_several_poses_one_is_asked_for(tmp_path: Path, kind: str) -> None:
    bag = Bag(kind, tmp_path)
    with bag.writer:
        bag.write("/tool", "geometry_msgs/msg/Pose", bag.poses(POSES))
        bag.write("/object", "geometry_msgs/msg/Pose", bag.poses(POSES[::-1]))
    with pytest.raises(BadInputError, match=r"import\.pose.*valid: /tool, /object"):
        poses_in(bag.path)
    (found,) = poses_in(bag.path, pose="tool")
    same(found, POSES)


@pytest.mark.parametrize("kind", KINDS)
def test_transforms_are_told_apart_by_their_frames(tmp_path: Path, kind: str) -> None:
    bag = Bag(kind, tmp_path)
    tf, one = "tf2_msgs/msg/TFMessage", "geometry_msgs/msg/TransformStamped"
    messages = []
    for stamp, row in zip(STAMPS, POSES.tolist(), strict=True):
        place = bag.make("geometry_msgs/msg/Vector3", *row[:3])
        turn = bag.make("geometry_msgs/msg/Quaternion", *row[4:], row[3])
        transform = bag.make("geometry_msgs/msg/Transform", place, turn)
        pairs = (("base", "tool0"), ("base", "camera"))
        messages.append(bag.make(tf, [bag.make(one, bag.header(stamp, a), b, transform) for a, b in pairs]))
    with bag.writer:
        bag.write("/tf", tf, messages)
    (found,) = poses_in(bag.path, pose="tool0")
    same(found, POSES)
    with pytest.raises(BadInputError, match=r"valid: /tf:base\.\.tool0, /tf:base\.\.camera"):
        poses_in(bag.path)
    # As the command line takes it, without quotes.
    named = api.load_config("import.pose=/tf:base..tool0").import_.pose
    (found,) = poses_in(bag.path, pose=named)
    same(found, POSES)


def test_a_topics_and_a_frames_own_name_come_before_longer_ones(tmp_path: Path) -> None:
    bag = Bag("ros2", tmp_path)
    kind, one = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped"
    with bag.writer:
        for topic, poses in (("/tool", POSES), ("/tool_target", POSES[::-1])):
            rows = zip(STAMPS, bag.poses(poses), strict=True)
            bag.write(topic, kind, [bag.make(kind, bag.header(stamp, "base"), each) for stamp, each in rows])
        for parent, child in (("base", "hand"), ("hand", "camera")):
            messages = []
            for stamp, row in zip(STAMPS, POSES.tolist(), strict=True):
                place = bag.make("geometry_msgs/msg/Vector3", *row[:3])
                turn = bag.make("geometry_msgs/msg/Quaternion", *row[4:], row[3])
                transform = bag.make("geometry_msgs/msg/Transform", place, turn)
                messages.append(bag.make(one, bag.header(stamp, parent), child, transform))
            bag.write(f"/tf_{child}", one, messages)
    for name in ("/tool", "hand", "camera"):
        (found,) = poses_in(bag.path, pose=name)
        same(found, POSES)


def stamped_bag(path: Path, stamps: list[int], logged: list[int]) -> Path:
    """Return a bag of the motion whose messages are stamped and logged at given times [ns]."""
    path.mkdir(exist_ok=True)
    bag, kind = Bag("ros2", path), "geometry_msgs/msg/PoseStamped"
    with bag.writer:
        rows = zip(stamps, bag.poses(POSES), strict=True)
        bag.write("/tool", kind, [bag.make(kind, bag.header(stamp, "base"), each) for stamp, each in rows], logged)
    return bag.path


def test_messages_out_of_order_are_put_in_the_order_of_their_stamps(tmp_path: Path) -> None:
    bag, kind = Bag("ros2", tmp_path), "geometry_msgs/msg/PoseStamped"
    order = [1, 0, *range(2, len(STAMPS))]
    with bag.writer:
        poses = bag.poses(POSES)
        messages = [bag.make(kind, bag.header(STAMPS[row], "base"), poses[row]) for row in order]
        bag.write("/tool", kind, messages)
    loaded = load(bag.path, declared({}), None)
    same(loaded.items[0].poses, POSES)
    np.testing.assert_allclose(loaded.items[0].times, TIMES, atol=1e-6)
    assert "time in ns as stamped" in loaded.reasons


def test_a_clock_that_begins_at_zero_stamps_and_one_set_back_does_not(tmp_path: Path) -> None:
    relative = [stamp - START for stamp in STAMPS]
    loaded = load(stamped_bag(tmp_path / "relative", relative, STAMPS), declared({}), None)
    assert "time in ns as stamped" in loaded.reasons
    assert len(loaded.items[0].poses) == len(POSES)
    back = [stamp - 10**11 * (row > 30) for row, stamp in enumerate(STAMPS)]
    loaded = load(stamped_bag(tmp_path / "back", back, STAMPS), declared({}), None)
    assert any("as logged, since stamps go back by up to 100 s" in each for each in loaded.reasons)
    same(loaded.items[0].poses, POSES)


def test_a_message_without_a_stamp_among_stamped_ones_is_left_out(tmp_path: Path) -> None:
    stamps = [0 if row == 7 else stamp for row, stamp in enumerate(STAMPS)]
    loaded = load(stamped_bag(tmp_path, stamps, STAMPS), declared({}), None)
    assert "time in ns as stamped; 1 that are not stamped left out" in loaded.reasons
    same(loaded.items[0].poses, np.delete(POSES, 7, axis=0))


def test_of_several_topics_of_joints_one_is_asked_for(tmp_path: Path) -> None:
    arm = load_parts().arm
    angles = np.array(arm.home) + 0.3 * TIMES[:, None] * np.arange(1, 7)
    bag, state, empty = Bag("ros2", tmp_path), "sensor_msgs/msg/JointState", np.zeros(0)
    with bag.writer:
        for topic, rows in (("/joint_states", angles), ("/commands/joint_states", angles + 0.05)):
            bag.write(
                topic,
                state,
                [
                    bag.make(state, bag.header(stamp, ""), list(arm.joint_names), row, empty, empty)
                    for stamp, row in zip(STAMPS, rows, strict=True)
                ],
            )
    with pytest.raises(BadInputError, match=r"which topic of joint states .* valid: /joint_states, /commands/joint_st"):
        load(bag.path, declared({}), arm)
    with pytest.raises(BadInputError, match="found 0 for 'nonsense'"):
        load(bag.path, declared({"pose": "nonsense"}), arm)
    (item,) = load(bag.path, declared({"pose": "/joint_states"}), arm).items
    same(item.poses, arm.forward(angles))


@pytest.mark.parametrize("kind", KINDS)
def test_joint_states_give_the_flange_whatever_their_order(tmp_path: Path, kind: str) -> None:
    arm = load_parts().arm
    angles = np.array(arm.home) + 0.3 * TIMES[:, None] * np.arange(1, 7)
    names, order = sorted(arm.joint_names), np.argsort(arm.joint_names)
    bag, state = Bag(kind, tmp_path), "sensor_msgs/msg/JointState"
    empty = np.zeros(0)
    with bag.writer:
        messages = [
            bag.make(state, bag.header(stamp, ""), names, row[order], empty, empty)
            for stamp, row in zip(STAMPS, angles, strict=True)
        ]
        bag.write("/joint_states", state, messages)
    (item,) = load(bag.path, declared({}), arm).items
    same(item.poses, arm.forward(angles))


def test_a_damaged_bag_is_refused_in_one_line(tmp_path: Path) -> None:
    bag = Bag("ros1", tmp_path)
    with bag.writer:
        bag.write("/tool", "geometry_msgs/msg/Pose", bag.poses(POSES))
    content = bag.path.read_bytes()
    for share in (0.1, 0.5, 0.95):
        bag.path.write_bytes(content[: int(share * len(content))])
        with pytest.raises(BadInputError, match="intact bag"):
            poses_in(bag.path)


@pytest.mark.parametrize("stamped", [1, 5, 30])
def test_where_many_messages_are_not_stamped_all_count_as_logged(tmp_path: Path, stamped: int) -> None:
    stamps = [stamp if row < stamped else 0 for row, stamp in enumerate(STAMPS)]
    loaded = load(stamped_bag(tmp_path, stamps, STAMPS), declared({}), None)
    same(loaded.items[0].poses, POSES)
    assert f"time in ns as logged, since {60 - stamped} of 60 messages are not stamped" in loaded.reasons


def test_a_name_in_the_list_can_be_named(tmp_path: Path) -> None:
    bag, kind = Bag("ros2", tmp_path), "geometry_msgs/msg/PoseStamped"
    with bag.writer:
        poses = bag.poses(POSES)
        rows = [bag.make(kind, bag.header(s, "world" if i % 2 else ""), poses[i]) for i, s in enumerate(STAMPS)]
        bag.write("/pose", kind, rows)
    (found,) = poses_in(bag.path, pose="/pose")
    same(found, POSES[::2])
    (found,) = poses_in(bag.path, pose="world")
    same(found, POSES[1::2])
