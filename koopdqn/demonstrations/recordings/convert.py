"""Recordings to demonstrations: the one place where units, orders, clocks and frames are settled, or asked for."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.demonstrations.recordings.recording import METRES, SECONDS, Clock, ImportSettings, Recording
from koopdqn.errors import BadInputError
from koopdqn.paths import arc_lengths
from koopdqn.pose import Array
from koopdqn.robot.arm import Arm
from koopdqn.settings import FARTHEST_M

# No rotation vector and no angle in radians is larger.
_LARGEST_RAD: Final = 2.0 * np.pi + 0.1
_LENGTH_TOLERANCE: Final = 0.01
# A clock whose typical tick is longer counts something else than seconds, and may do so where whole ones take longer.
_LONGEST_TICK_S: Final = 1.0
_LONGEST_WHOLE_S: Final = 600.0
# Seconds since 1970 between 2001 and 2100: a clock that counts them shows its unit.
_EPOCH_S: Final = (1e9, 4.1e9)
# A turn counts as so much of path where the path is the clock [m/rad].
_TURN_LENGTH: Final = 0.1
_MATRIX_TOLERANCE: Final = 0.01
# Two orientations of one pose are the same within this [°].
_SAME_TURN_DEG: Final = 1.0
# The measured pose lies this still in the flange that joints give [m, rad], if it is a tool on this arm.
_SAME_ARM: Final = (0.001, 0.01)


def converted(recording: Recording, declared: ImportSettings, arm: Arm | None) -> tuple[Demonstration, list[str]]:
    """Return the demonstration that a recording shows, and what was taken for what and why, a line each.

    The arm gives the flange where only joints were recorded.

    Raises:
        BadInputError: something must be declared, named in the message; or the recording breaks a rule.
    """
    reasons = list(recording.reasons)
    joints = _joints(recording, declared, reasons)
    asked: list[str] = []
    if recording.of_joints:
        poses = _forward(recording, joints, declared, arm, reasons)
        _check_asked(recording, declared, asked)
    else:
        position = quaternion = np.zeros(0)
        try:
            position = _position(recording, declared, reasons)
        except AskError as error:
            asked.append(str(error))
        try:
            quaternion = _quaternion(recording, declared, reasons)
            _tell_other(recording, declared, quaternion, reasons)
        except AskError as error:
            asked.append(str(error))
        _check_asked(recording, declared, asked)
        poses = _in_base(recording, np.concatenate([position, quaternion], axis=1), declared, reasons)
        poses = _at_flange(recording, poses, joints, declared, arm, reasons)
    if len(poses) < 2:
        raise BadInputError(f"demos {recording.where}: must hold at least 2 samples, found {len(poses)}")
    times, kept = _times(recording, poses, declared, reasons)
    own = joints[kept] if joints is not None and arm is not None and joints.shape[1] == len(arm.joint_names) else None
    try:
        item = Demonstration(times[kept], poses[kept], own if recording.of_joints else None)
    except BadInputError as error:
        raise BadInputError(f"demos {recording.where}: {error}") from error
    return item, reasons


def _in_base(recording: Recording, poses: Array, declared: ImportSettings, reasons: list[str]) -> Array:
    """Return poses (N, 7) of the recording's frame in the arm's base."""
    if declared.base is not None:
        reasons.append("told in the arm's base, as import.base declares")
        base = pose.make(declared.base[:3], pose.from_rotation_vector(declared.base[3:]))
        return pose.compose(pose.inverse(base), poses)
    if recording.frame:
        reasons.append(f"frame {recording.frame} is taken as the arm's base; import.base says where that stands in it")
    elif recording.turn is not None:
        reasons.append("in the arm's base, of the flange, unless import.base and import.tool say otherwise")
    return poses


def of_one_unit(recordings: Sequence[Recording]) -> list[Recording]:
    """Return the recordings of a file, KUKA's angles in degrees if one of all is over 2π: a unit is the file's."""
    turns = [each.turn for each in recordings if each.rotation == "kuka" and each.turn is not None]
    if not any((np.abs(turn) > _LARGEST_RAD).any() for turn in turns):
        return list(recordings)
    return [replace(each, angles=each.angles or "deg") if each.rotation == "kuka" else each for each in recordings]


class AskError(BadInputError):
    """Something must be declared."""


def _ask(recording: Recording, key: str, rule: str) -> AskError:
    return AskError(f"import.{key}: must be given for {recording.where}: {rule}")


def _check_asked(recording: Recording, declared: ImportSettings, asked: list[str]) -> None:
    """Raise AskError if one or more things must be declared; all at once, so that nobody has to try again and again."""
    if recording.times is None and recording.rate_hz is None and not (declared.rate_hz or declared.speed_m_s):
        rule = "rows a second, or import.speed_m_s in its place, as there is no time column"
        asked.append(str(_ask(recording, "rate_hz", rule)))
    if asked:
        where = f" for {recording.where}"
        raise AskError("; ".join([asked[0], *(each.replace(where, "", 1) for each in asked[1:])]))


def _position(recording: Recording, declared: ImportSettings, reasons: list[str]) -> Array:
    values = recording.origin
    units = declared.units or recording.units
    largest = float(np.abs(values).max(initial=0.0))
    if units is None:
        if largest > FARTHEST_M:
            raise _ask(recording, "units", f"mm or cm, as the largest coordinate is {largest:g}, too far in metres")
        reasons.append(f"in metres, as no coordinate is over {FARTHEST_M:g} (largest {largest:.3g})")
        return values
    reasons.append(f"in {units}, as {'declared' if declared.units else 'its format or a name says'}")
    metres = values * METRES[units]
    if largest * METRES[units] > FARTHEST_M:
        raise BadInputError(
            f"demos {recording.where}: positions must be within {FARTHEST_M:g} m, found {largest:g} {units}"
        )
    return metres


def _quaternion(recording: Recording, declared: ImportSettings, reasons: list[str]) -> Array:
    count = len(recording.origin)
    if recording.turn is None:
        if declared.orientation is None:
            rule = "a quaternion [w,x,y,z] for all poses, as only positions are recognised"
            if recording.unused:
                rule += f"; import.columns names it if it is among {', '.join(recording.unused[:20])}"
            raise _ask(recording, "orientation", rule)
        reasons.append("orientation as import.orientation declares")
        return np.broadcast_to(pose.normalized(declared.orientation), (count, 4)).copy()
    turn = recording.turn
    if declared.orientation is not None:
        reasons.append("orientation as recorded, and import.orientation without effect")
    if declared.rotation is not None and recording.rotation not in (None, "vector", "angles", "kuka"):
        reasons.append(f"orientation as {recording.rotation}, as names say, and import.rotation without effect")
    if recording.rotation == "transform":
        by_columns = recording.by_columns
        reasons.append(f"4×4 matrices by {'columns' if by_columns else 'rows'}, as 0 0 0 1 stands there")
        whole = turn.reshape(-1, 4, 4)
        return _from_matrix(recording, (whole.transpose(0, 2, 1) if by_columns else whole)[:, :3, :3])
    if recording.rotation == "matrix":
        return _from_matrix(recording, turn.reshape(-1, 3, 3))
    if recording.rotation == "quaternion":
        return _ordered(recording, declared, reasons)
    rotation = declared.rotation or recording.rotation
    largest = float(np.abs(turn).max(initial=0.0))
    angles = declared.angles or recording.angles
    if declared.rotation is None and recording.rotation == "vector" and (largest > _LARGEST_RAD or angles == "deg"):
        # Rotation vectors are in radians wherever they are documented; arms that log degrees call their angles so.
        rotation = None
    if rotation not in ("vector", "angles", "kuka"):
        rule = "vector or angles, as three numbers tell orientation in either way"
        if largest > _LARGEST_RAD and angles is None:
            rule += f"; import.angles: deg or rad, as the largest is {largest:g}, more than once around in rad"
        raise _ask(recording, "rotation", rule)
    stated = "as a name says" if angles else f"as none is over 2π (largest {largest:.3g})"
    if recording.rotation == "kuka" and rotation != "vector" and angles != "rad":
        if angles is None and largest <= _LARGEST_RAD:
            rule = f"deg or rad, as KUKA writes A B C in deg, and the largest is {largest:.3g}, which may be either"
            raise _ask(recording, "angles", rule)
        angles, stated = "deg", "as KUKA writes A B C"
    if angles is None and largest > _LARGEST_RAD:
        raise _ask(recording, "angles", f"deg or rad, as the largest is {largest:g}, more than once around in rad")
    kind = "rotation vectors" if rotation == "vector" else "roll, pitch and yaw about fixed axes"
    reasons.append(f"{kind} in {angles or 'rad'}, {'as declared' if declared.angles else stated}")
    radians = np.radians(turn) if angles == "deg" else turn
    if np.abs(radians).max(initial=0.0) > 2.0 * _LARGEST_RAD:
        raise BadInputError(f"demos {recording.where}: angles must turn at most twice around, found {largest:g}")
    return pose.from_rotation_vector(radians) if rotation == "vector" else pose.from_roll_pitch_yaw(radians)


def _tell_other(recording: Recording, declared: ImportSettings, quaternion: Array, reasons: list[str]) -> None:
    """Say so if another orientation of the same poses is known and tells otherwise in most rows."""
    other = recording.other
    if other is None or other.turn is None:
        return
    if other.angles is None and np.abs(other.turn).max(initial=0.0) > _LARGEST_RAD:
        other = replace(other, angles="deg")
    try:
        found = _quaternion(replace(other, position=recording.position), declared, [])
    except BadInputError:
        # What is no orientation, such as rates, says nothing against one.
        return
    apart = float(np.degrees(np.median(pose.angle_of(pose.multiply(quaternion, pose.conjugate(found))))))
    if apart > _SAME_TURN_DEG:
        reasons.append(
            f"the orientations of {other.where} are {apart:.1f}° apart, and the first is read:"
            " import.columns={x: NAME, …} names another"
        )


def _ordered(recording: Recording, declared: ImportSettings, reasons: list[str]) -> Array:
    turn, order = recording.turn, recording.order or declared.quaternion
    assert turn is not None
    if order is None:
        raise _ask(recording, "quaternion", "wxyz or xyzw, as nothing says which of the four numbers is w")
    if recording.order is None:
        reasons.append(f"quaternions {order}, as declared")
    elif declared.quaternion not in (None, order):
        reasons.append(f"quaternions {order}, as names or the format say, and import.quaternion without effect")
    length = np.linalg.norm(turn, axis=1)
    wrong = np.flatnonzero(np.abs(length - 1.0) > _LENGTH_TOLERANCE)
    if len(wrong):
        raise BadInputError(
            f"demos {recording.where}: {recording.row(int(wrong[0]))}: quaternions must have length 1 within"
            f" {_LENGTH_TOLERANCE}, found {length[wrong[0]]:.4g}"
        )
    unit = turn / length[:, None]
    return np.asarray(unit if order == "wxyz" else unit[:, [3, 0, 1, 2]])


def _from_matrix(recording: Recording, matrices: Array) -> Array:
    apart = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    turned = np.linalg.det(matrices) > 0
    wrong = np.flatnonzero((apart > _MATRIX_TOLERANCE) | ~turned)
    if len(wrong):
        raise BadInputError(
            f"demos {recording.where}: {recording.row(int(wrong[0]))}: must hold a rotation matrix, found one that"
            f" differs by {apart[wrong[0]]:.3g} from it"
        )
    return pose.from_matrix(matrices)


def _joints(recording: Recording, declared: ImportSettings, reasons: list[str]) -> Array | None:
    if recording.joints is None:
        return None
    largest, angles = float(np.abs(recording.joints).max(initial=0.0)), recording.joint_angles
    if recording.of_joints:
        angles = declared.angles or angles
        if angles is None and largest > _LARGEST_RAD:
            raise _ask(recording, "angles", f"deg or rad, as the largest joint angle is {largest:g}")
        reasons.append(f"joint angles in {angles or 'rad'}")
    elif angles is None:
        # Beside a quaternion or a matrix a declared unit can be of the joints alone.
        free = recording.rotation in ("quaternion", "matrix", "transform")
        angles = (declared.angles if free else None) or ("deg" if largest > _LARGEST_RAD else "rad")
    return np.radians(recording.joints) if angles == "deg" else recording.joints


def _forward(
    recording: Recording, joints: Array | None, declared: ImportSettings, arm: Arm | None, reasons: list[str]
) -> Array:
    assert joints is not None
    if arm is None:
        raise BadInputError(f"demos {recording.where}: joints need an arm to make poses of them, found none given")
    if joints.shape[1] != len(arm.joint_names):
        raise BadInputError(
            f"demos {recording.where}: joints must be the {len(arm.joint_names)} of {arm.name} (robot=), found"
            f" {joints.shape[1]}"
        )
    reasons.append(f"flange from the joints by the kinematics of {arm.name}")
    without = [f"import.{key}" for key in ("base", "tool") if getattr(declared, key) is not None]
    if without:
        reasons.append(f"{' and '.join(without)} without effect: joints give the flange in the arm's base")
    return arm.forward(joints)


def _at_flange(
    recording: Recording,
    poses: Array,
    joints: Array | None,
    declared: ImportSettings,
    arm: Arm | None,
    reasons: list[str],
) -> Array:
    """Return the flange's poses where the file, a declaration or the joints say how the recorded point lies in it."""
    tool = recording.tool
    if declared.tool is not None:
        tool = pose.make(declared.tool[:3], pose.from_rotation_vector(declared.tool[3:]))
        reasons.append("moved from the recorded point to the flange by import.tool")
    elif tool is not None:
        changes = ", which changes on the way" if tool.ndim > 1 else ""
        reasons.append(f"moved from the tool centre point to the flange by the file's own tcp_offset{changes}")
    elif joints is not None and arm is not None and joints.shape[1] == len(arm.joint_names):
        offset = pose.compose(pose.inverse(arm.forward(joints)), poses)
        spread = pose.position_distance(offset, offset[0]).max(), pose.rotation_distance(offset, offset[0]).max()
        if spread[0] < _SAME_ARM[0] and spread[1] < _SAME_ARM[1]:
            shown = np.round(1e3 * offset[0, :3], 1).tolist()
            reasons.append(f"moved to the flange: the joints show the recorded point fixed at {shown} mm in it")
            return arm.forward(joints)
    return poses if tool is None else pose.compose(poses, pose.inverse(tool))


def _times(
    recording: Recording, poses: Array, declared: ImportSettings, reasons: list[str]
) -> tuple[Array, np.ndarray]:
    """Return times (N,) [s] and which rows are kept, those whose time grows."""
    every = np.ones(len(poses), dtype=bool)
    if declared.speed_m_s is not None:
        turns = np.concatenate([[0.0], np.cumsum(pose.rotation_distance(poses[1:], poses[:-1]))])
        times = (arc_lengths(poses[:, pose.POSITION]) + _TURN_LENGTH * turns) / declared.speed_m_s
        reasons.append(f"time from the path at {declared.speed_m_s:g} m/s, as declared")
        return times, _growing(times)
    rate = declared.rate_hz or (recording.rate_hz if recording.times is None else None)
    if rate is not None:
        reasons.append(f"{rate:g} rows a second, as {'declared' if declared.rate_hz else 'the file says'}")
        return np.arange(len(poses)) / rate, every
    times = _seconds(recording, declared, reasons)
    back = np.flatnonzero(np.diff(times) < 0)
    if len(back):
        row = int(back[0]) + 1
        raise BadInputError(
            f"demos {recording.where}: {recording.row(row)}: time must increase, found {times[row]:g} after"
            f" {times[row - 1]:g} s; a column demo tells several demonstrations apart, import.rate_hz replaces the time"
        )
    kept = _growing(times)
    lost = int(len(times) - kept.sum())
    if 2 * lost > len(times):
        raise _ask(recording, "rate_hz", f"rows a second, as {lost} of {len(times)} rows repeat the time before")
    if lost:
        reasons.append(f"{lost} rows that repeat the time before left out")
    return times, kept


def _growing(times: Array) -> np.ndarray:
    """Return which times (N,) are later than all before."""
    before = np.concatenate([[-np.inf], np.maximum.accumulate(times)[:-1]])
    return np.asarray(times > before)


def _seconds(recording: Recording, declared: ImportSettings, reasons: list[str]) -> Array:
    ticks, clock = recording.times, declared.clock or recording.clock
    assert ticks is not None
    steps = np.diff(ticks)
    tick = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    # A count of microseconds since a machine began can have the size of seconds since 1970, but not their steps.
    epoch = next((unit for unit in SECONDS if _is_epoch(ticks, unit) and tick * SECONDS[unit] <= _LONGEST_TICK_S), None)
    if clock is None and epoch is not None:
        clock = epoch
        reasons.append(f"time in {clock} since 1970, as its size shows")
    if clock is None:
        if tick > _LONGEST_TICK_S or (tick == _LONGEST_TICK_S and np.ptp(ticks) > _LONGEST_WHOLE_S):
            whole = f" for {np.ptp(ticks):g} s" if tick == _LONGEST_TICK_S else ""
            rule = f"s, ms, us or ns, as {tick:g} s from row to row{whole} are too long to be taken for seconds"
            raise _ask(recording, "clock", rule)
        reasons.append(f"time in s, as a row takes {1e3 * tick:.3g} ms")
        clock = "s"
    if epoch is None and clock == "s":
        return ticks
    return np.asarray((ticks - ticks[0]) * SECONDS[clock])


def _is_epoch(ticks: Array, unit: Clock) -> bool:
    first, last = ticks[[0, -1]] * SECONDS[unit]
    return bool(_EPOCH_S[0] < first < _EPOCH_S[1] and _EPOCH_S[0] < last < _EPOCH_S[1])
