"""Tables to recordings: the columns that names show, or that numbers without names show by what they are."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from koopdqn.demonstrations.recordings.layout import layout_of, listed
from koopdqn.demonstrations.recordings.names import PoseColumns
from koopdqn.demonstrations.recordings.recording import Columns, ImportSettings, Recording
from koopdqn.errors import BadInputError
from koopdqn.pose import Array

# Four numbers that have length 1 within this in every row are a quaternion.
_UNIT_LENGTH: Final = 0.01
_POSE: Final = ("x", "y", "z", "q0", "q1", "q2", "q3")


def recordings_of(columns: Columns, declared: ImportSettings, stated: Recording) -> list[Recording]:
    """Return the recordings of a table, one for each text of its column of demonstrations.

    What the file's format ``stated`` of units, order and rate holds where the columns' own names say nothing.

    Raises:
        BadInputError: the columns are not recognised, or a cell is no number.
    """
    layout = layout_of(columns.where, columns.names, declared)
    pose = layout.pose
    parts = (*layout.time, *layout.joints, *layout.tool, *((*pose.position, *pose.turn) if pose else ()))
    used = {*parts, layout.demo}
    needed = tuple(dict.fromkeys(parts))
    # All at once: to read text takes longer than what follows.
    numbers = columns.numbers(needed)

    def taken(places: tuple[int, ...]) -> Array | None:
        return numbers[:, [needed.index(place) for place in places]] if places else None

    tool = taken(layout.tool)
    found = replace(
        stated,
        where=columns.where,
        rows=columns.lines,
        joints=taken(layout.joints),
        joint_angles=layout.joint_angles,
        times=_times(taken(layout.time)),
        clock=layout.clock or stated.clock,
        tool=None if tool is None else _tool(tool),
        unused=tuple(name for place, name in enumerate(columns.names) if place not in used),
        reasons=(*stated.reasons, *layout.reasons),
    )
    if pose is not None:
        found = replace(
            found,
            position=None if pose.rotation == "transform" else taken(pose.position),
            turn=taken(pose.turn),
            rotation=pose.rotation,
            order=pose.order or stated.order,
            units=pose.units or stated.units,
            angles=pose.angles or stated.angles,
            other=_other(pose, columns),
        )
    return [found] if layout.demo is None else _apart(found, columns.texts(layout.demo))


def _times(ticks: Array | None) -> Array | None:
    """Return the one column of time (N,), or the sum of two: seconds and nanoseconds."""
    if ticks is None:
        return None
    return ticks[:, 0] + 1e-9 * ticks[:, 1] if ticks.shape[1] == 2 else ticks[:, 0]


def _other(pose: PoseColumns, columns: Columns) -> Recording | None:
    """Return the orientation that is not read, if there are two; None where its cells are no numbers."""
    other = pose.other
    if other is None:
        return None
    where = " and ".join(listed(columns.names, places) for places in (pose.turn, other.turn))
    try:
        turn = columns.numbers(other.turn)
    except BadInputError:
        return None
    return Recording(where, turn=turn, rotation=other.rotation, order=other.order, angles=other.angles)


def _tool(values: Array) -> Array:
    """Return the tool's pose (7,), or one for each row (N, 7) where it changes."""
    from koopdqn import pose

    poses = pose.make(values[:, :3], pose.from_rotation_vector(values[:, 3:]))
    return poses if np.ptp(values, axis=0).max() > 0 else poses[0]


def _apart(whole: Recording, texts: Sequence[str]) -> list[Recording]:
    """Return the rows of each text, in the order in which the texts first appear."""
    numbered = {text: number for number, text in enumerate(dict.fromkeys(texts))}
    label = np.array([numbered[text] for text in texts])
    order = np.argsort(label, kind="stable")
    parts = np.split(order, np.searchsorted(label[order], np.arange(1, len(numbered))))
    return [_part_of(whole, rows, f"demo {text}") for text, rows in zip(numbered, parts, strict=True)]


def _part_of(whole: Recording, rows: np.ndarray, name: str) -> Recording:
    """Return some rows of a recording, in growing order, as one of their own."""
    lines = rows if whole.rows is None else whole.rows[rows]
    # What lies in one piece need not be copied.
    together = len(rows) > 0 and rows[-1] - rows[0] == len(rows) - 1
    taken = slice(rows[0], rows[-1] + 1) if together else rows
    return replace(
        whole,
        where=f"{whole.where}: {name}",
        rows=lines,
        position=_taken(whole.position, taken),
        turn=_taken(whole.turn, taken),
        other=None if whole.other is None else replace(whole.other, turn=_taken(whole.other.turn, taken)),
        joints=_taken(whole.joints, taken),
        times=_taken(whole.times, taken),
        tool=whole.tool if whole.tool is None or whole.tool.ndim == 1 else whole.tool[taken],
    )


def _taken(values: Array | None, rows: np.ndarray | slice) -> Array | None:
    return None if values is None else values[rows]


def unnamed(where: str, values: Array, declared: ImportSettings) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return names for columns (N, k) that have none, by what their numbers are, and why.

    A quaternion shows by its length of 1, a time by its growth; one or two poses a row, behind a time or not, are
    recognised. Everything else must be declared.

    Raises:
        BadInputError: they are nothing that can be recognised.
    """
    count = values.shape[1]
    if declared.columns is not None:
        return tuple(str(index) for index in range(count)), ()
    if count == 16:
        return tuple(f"matrix_{index}" for index in range(16)), ("sixteen numbers a row: a 4×4 matrix",)
    timed = count % 7 == 1 and count > 7 and bool(np.all(np.diff(values[:, 0]) >= 0) and np.ptp(values[:, 0]) > 0)
    names: list[str] = ["t"] if timed else []
    reasons = ["first column grows: time"] if timed else []
    while count - len(names) >= 7:
        begin, which = len(names), (len(names) - timed) // 7
        last, first = (_is_unit(values[:, begin + a : begin + a + 4]) for a in (3, 0))
        if last == first:
            break
        part = _POSE if last else (*_POSE[3:], *_POSE[:3])
        names += [f"pose{which + 1}_position_{n}" if n in "xyz" else f"pose{which + 1}_quat_{n[1]}" for n in part]
        which_four = "last" if last else "first"
        reasons.append(f"columns {begin} to {begin + 6}: a pose, as the {which_four} four have length 1: a quaternion")
    if not names or len(names) != count:
        raise BadInputError(
            f"import.columns: must name the {count} columns of {where}, which has no header, in their order,"
            " such as [t,x,y,z,qx,qy,qz,qw] (_ leaves one out)"
        )
    return tuple(names), tuple(reasons)


def _is_unit(values: Array) -> bool:
    return bool(np.all(np.abs(np.linalg.norm(values, axis=1) - 1.0) < _UNIT_LENGTH))
