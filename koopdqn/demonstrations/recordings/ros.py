"""Recordings as ROS writes them: bags of ROS 1, bags of ROS 2, and MCAP, read by ``rosbags``."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from koopdqn.demonstrations.recordings.declared import ImportSettings
from koopdqn.demonstrations.recordings.recording import Recording
from koopdqn.errors import BadInputError
from koopdqn.robot.arm import Arm

_BAG: Final = b"#ROSBAG V2.0"
_MCAP: Final = b"\x89MCAP0\r\n"
_SQLITE: Final = b"SQLite format 3\x00"
LARGEST_BYTES: Final = 1 << 32
"""The largest bag that is read."""
MOST_MESSAGES: Final = 2_000_000
"""The most poses that are read from one."""
_SETS: Final = ("/PoseStamped", "/Pose", "/PoseWithCovarianceStamped", "/TransformStamped", "/Odometry", "/TFMessage")
_JOINTS: Final = "/JointState"


def recognise(path: Path) -> str | None:
    """Return why a file or folder is a bag, or None."""
    if path.is_dir():
        return "it holds metadata.yaml, as a ROS 2 bag" if (path / "metadata.yaml").is_file() else None
    with path.open("rb") as file:
        head = file.read(16)
    if head.startswith(_BAG):
        return "it begins as a ROS 1 bag"
    if head.startswith(_MCAP):
        return "it begins as MCAP"
    return "it is SQLite named .db3, as a ROS 2 bag" if head == _SQLITE and path.suffix == ".db3" else None


def read(path: Path, declared: ImportSettings, arm: Arm | None) -> list[Recording]:
    """Return the recording of the one pose that a bag holds or ``import.pose`` names; else that of its joints.

    Raises:
        BadInputError: the bag is damaged or too large, or holds no pose, or several.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    size = sum(each.stat().st_size for each in ([path] if path.is_file() else path.iterdir()))
    if size > LARGEST_BYTES:
        raise BadInputError(f"demos {path}: must be at most {LARGEST_BYTES >> 20} MiB, found {size >> 20} MiB")
    try:
        # Messages of older ROS 2 bags do not say what they are made of; of those here it never changed.
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            return [_read(path, reader, declared, arm)]
    except BadInputError:
        raise
    # The reader raises whatever a damaged file leads it to.
    except Exception as error:
        raise BadInputError(f"demos {path}: must be an intact bag, found: {error}") from error


def _read(path: Path, reader: Any, declared: ImportSettings, arm: Arm | None) -> Recording:
    kinds = {each.topic: each.msgtype for each in reader.connections}
    wanted = [each for each in reader.connections if each.msgtype.endswith(_SETS)]
    series: dict[str, list[tuple[float, ...]]] = {}
    count = 0
    # An empty choice would be all of them.
    for connection, logged, raw in reader.messages(connections=wanted) if wanted else ():
        for name, row in _rows(connection.topic, reader.deserialize(raw, connection.msgtype), logged):
            series.setdefault(name, []).append(row)
            count += 1
            if count > MOST_MESSAGES:
                raise BadInputError(f"demos {path}: must hold at most {MOST_MESSAGES} poses, found more")
    chosen = {name: rows for name, rows in series.items() if declared.pose is None or declared.pose in name}
    exact = {name: rows for name, rows in chosen.items() if name == declared.pose}
    chosen = exact or chosen
    if len(chosen) > 1 or (series and not chosen):
        raise BadInputError(
            f"import.pose: must name which pose of {path} to read, found {len(chosen)}; valid: {', '.join(series)}"
        )
    if chosen:
        ((name, rows),) = chosen.items()
        return _poses(path, name, np.array(rows), kinds)
    joints = [each for each in reader.connections if each.msgtype.endswith(_JOINTS)]
    if not joints or arm is None:
        held = ", ".join(f"{topic} ({kind})" for topic, kind in kinds.items()) or "nothing"
        raise BadInputError(f"demos {path}: must hold poses, transforms or joint states, found {held}")
    return _joints(path, reader, joints, arm)


def _rows(topic: str, message: Any, logged: int) -> Iterator[tuple[str, tuple[float, ...]]]:
    """Yield name and row of every pose in a message: time stamped and logged [ns], x y z, qx qy qz qw."""
    transforms = getattr(message, "transforms", None)
    if transforms is not None:
        for each in transforms:
            yield from _rows(topic, each, logged)
        return
    header = getattr(message, "header", None)
    stamp = 0 if header is None else header.stamp.sec * 1_000_000_000 + header.stamp.nanosec
    if hasattr(message, "transform"):
        topic = f"{topic}:{header.frame_id}→{message.child_frame_id}"  # type: ignore[union-attr]  # those have one
        place, turn = message.transform.translation, message.transform.rotation
    else:
        while hasattr(message, "pose"):
            message = message.pose
        place, turn = message.position, message.orientation
        topic = topic if header is None or not header.frame_id else f"{topic} in {header.frame_id}"
    yield topic, (float(stamp), float(logged), place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w)


def _poses(path: Path, name: str, rows: np.ndarray, kinds: dict[str, str]) -> Recording:
    stamped = np.all(np.diff(rows[:, 0]) >= 0) and rows[0, 0] > 0
    if not stamped:
        rows = rows[np.argsort(rows[:, 1], kind="stable")]
    topic, _, frame = name.partition(" in ")
    kind = kinds.get(topic.partition(":")[0], "")
    return Recording(
        f"{path}: {name}",
        position=rows[:, 2:5],
        turn=rows[:, 5:9],
        rotation="quaternion",
        order="xyzw",
        units="m",
        times=rows[:, 0 if stamped else 1],
        clock="ns",
        frame=frame or topic.partition(":")[2].partition("→")[0],
        reasons=(
            f"topic {topic} of {kind}, in metres and with xyzw by ROS's own rules",
            f"time in ns as {'stamped' if stamped else 'logged, since messages are not stamped'}",
        ),
    )


def _joints(path: Path, reader: Any, connections: list[Any], arm: Arm) -> Recording:
    times, angles = [], []
    for connection, logged, raw in reader.messages(connections=connections):
        message = reader.deserialize(raw, connection.msgtype)
        if not set(arm.joint_names) <= set(message.name):
            continue
        stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
        times.append(float(stamp or logged))
        angles.append(np.asarray(message.position)[[list(message.name).index(name) for name in arm.joint_names]])
    if len(angles) < 2:
        raise BadInputError(
            f"demos {path}: joint states must name {', '.join(arm.joint_names)} (robot={arm.name}), found none that do"
        )
    order = np.argsort(times, kind="stable")
    why = (f"joint states of {connections[0].topic}, joints by their names",)
    return Recording(
        str(path), joints=np.array(angles)[order], times=np.array(times)[order], angles="rad", clock="ns", reasons=why
    )
