"""Recordings as ROS writes them: bags of ROS 1, bags of ROS 2, and MCAP, read by ``rosbags``."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from koopdqn.demonstrations.recordings.recording import ImportSettings, Recording
from koopdqn.errors import BadInputError
from koopdqn.pose import Array
from koopdqn.robot.arm import Arm

LARGEST_BYTES: Final = 1 << 32
"""The largest bag that is read."""
MOST_MESSAGES: Final = 2_000_000
"""The most poses that are read from one."""
_SETS: Final = ("/PoseStamped", "/Pose", "/PoseWithCovarianceStamped", "/TransformStamped", "/Odometry", "/TFMessage")
_JOINTS: Final = "/JointState"
# What stands between topic and frames in the name of a pose, as the command line takes it without quotes.
_OF, _TO, _IN = ":", "..", " in "
# A message that was logged or sent later than others is so late at most; longer, and the clock was set back [ns].
_LATEST_NS: Final = 1e9
# No clock that began with the robot's program shows more [ns], and any that counts from 1970 does.
_LONGEST_RUN_NS: Final = 1e18
# A larger share of messages without a stamp, and stamps are no clock.
_FEW: Final = 0.1


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
    if series:
        name = _chosen(path, "pose", list(series), declared)
        return _poses(path, name, np.array(series[name]), kinds)
    joints = [each for each in reader.connections if each.msgtype.endswith(_JOINTS)]
    if not joints or arm is None:
        held = ", ".join(f"{topic} ({kind})" for topic, kind in kinds.items()) or "nothing"
        raise BadInputError(f"demos {path}: must hold poses, transforms or joint states, found {held}")
    return _joints(path, reader, joints, declared, arm)


def _chosen(path: Path, what: str, names: list[str], declared: ImportSettings) -> str:
    """Return the one name that ``import.pose`` is, or is a part of; the only one where nothing is declared.

    A topic's own name and a child frame's own come before other names that hold them.
    """
    wanted = declared.pose
    left = [name for name in names if wanted is None or wanted in name]
    own = [name for name in left if wanted in (name, name.partition(_IN)[0], name.partition(_TO)[2])]
    chosen = [name for name in left if name == wanted] or own or left
    if len(chosen) != 1:
        found = f"{len(chosen)}{'' if wanted is None else f' for {wanted!r}'}"
        raise BadInputError(
            f"import.pose: must name which {what} of {path} to read, found {found}; valid: {', '.join(names)}"
        )
    return chosen[0]


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
        frames = f"{header.frame_id}{_TO}{message.child_frame_id}"  # type: ignore[union-attr]  # those have one
        topic = f"{topic}{_OF}{frames}"
        place, turn = message.transform.translation, message.transform.rotation
    else:
        while hasattr(message, "pose"):
            message = message.pose
        place, turn = message.position, message.orientation
        topic = topic if header is None or not header.frame_id else f"{topic}{_IN}{header.frame_id}"
    yield topic, (float(stamp), float(logged), place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w)


def _clock(stamped: Array, logged: Array) -> tuple[Array, np.ndarray, str]:
    """Return times (N,) [ns], the rows (M,) to read in their order, and which clock that is.

    A message is stamped nearer to its motion than it is logged. Bags hold few messages out of their order, but a clock
    that was set back is none.
    """
    # Where a clock counts from 1970, as most do, 0 is no stamp.
    unset = (stamped <= 0) & (stamped.max(initial=0.0) > _LONGEST_RUN_NS)
    rows = np.flatnonzero(~unset)
    back = float((np.maximum.accumulate(stamped[rows]) - stamped[rows]).max(initial=0.0))
    if not stamped.any():
        why = "messages are not stamped"
    elif unset.mean() > _FEW:
        why = f"{int(unset.sum())} of {len(unset)} messages are not stamped"
    elif back > _LATEST_NS:
        why = f"stamps go back by up to {1e-9 * back:.3g} s"
    else:
        left_out = f"; {int(unset.sum())} that are not stamped left out" if unset.any() else ""
        return stamped, rows[np.argsort(stamped[rows], kind="stable")], f"stamped{left_out}"
    return logged, np.argsort(logged, kind="stable"), f"logged, since {why}"


def _poses(path: Path, name: str, rows: Array, kinds: dict[str, str]) -> Recording:
    times, order, clock = _clock(rows[:, 0], rows[:, 1])
    topic, _, frame = name.partition(_IN)
    topic, _, frames = topic.partition(_OF)
    shown = f"{topic} ({frames})" if frames else topic
    return Recording(
        f"{path}: {name}",
        position=rows[order, 2:5],
        turn=rows[order, 5:9],
        rotation="quaternion",
        order="xyzw",
        units="m",
        times=times[order],
        clock="ns",
        frame=frame or frames.partition(_TO)[0],
        reasons=(
            f"topic {shown} of {kinds.get(topic, '')}, in metres and with xyzw by ROS's own rules",
            f"time in ns as {clock}",
        ),
    )


def _joints(path: Path, reader: Any, connections: list[Any], declared: ImportSettings, arm: Arm) -> Recording:
    series: dict[str, list[tuple[float, ...]]] = {}
    for connection, logged, raw in reader.messages(connections=connections):
        message = reader.deserialize(raw, connection.msgtype)
        names = list(message.name)
        if set(arm.joint_names) <= set(names):
            stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
            angles = (float(message.position[names.index(name)]) for name in arm.joint_names)
            series.setdefault(connection.topic, []).append((float(stamp), float(logged), *angles))
    if not series:
        raise BadInputError(
            f"demos {path}: joint states must name {', '.join(arm.joint_names)} (robot={arm.name}), found none that do"
        )
    topic = _chosen(path, "topic of joint states", list(series), declared)
    rows = np.array(series[topic])
    times, order, clock = _clock(rows[:, 0], rows[:, 1])
    why = (f"joint states of {topic}, joints by their names", f"time in ns as {clock}")
    return Recording(str(path), joints=rows[order, 2:], times=times[order], joint_angles="rad", clock="ns", reasons=why)
