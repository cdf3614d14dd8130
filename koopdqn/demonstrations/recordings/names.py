"""Column names: what a name says of its column, and the poses that names show together."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from koopdqn.demonstrations.recordings.recording import Angles, Clock, QuaternionOrder, RowRotation, Units
from koopdqn.errors import BadInputError

_LENGTH_UNITS: Final[dict[str, Units]] = {"m": "m", "meter": "m", "metre": "m", "meters": "m", "cm": "cm", "mm": "mm"}
_ANGLE_UNITS: Final[dict[str, Angles]] = {"rad": "rad", "deg": "deg", "°": "deg", "degree": "deg", "degrees": "deg"}
_CLOCK_UNITS: Final[dict[str, Clock]] = {
    "s": "s",
    "sec": "s",
    "second": "s",
    "seconds": "s",
    "ms": "ms",
    "msec": "ms",
    "us": "us",
    "µs": "us",
    "usec": "us",
    "ns": "ns",
    "nsec": "ns",
    "nanoseconds": "ns",
}
_KNOWN_UNITS: Final = {**_LENGTH_UNITS, **_ANGLE_UNITS, **_CLOCK_UNITS}
_BRACKETED: Final = re.compile(r"[\[(]\s*([^\[\]()\d]*?)\s*[\])]\s*$")
_WORDS: Final = re.compile(
    r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])|(?<=[^\W\d_])(?=\d)|[^\w°%]+|_+|(?<=\d)(?=[a-zA-Z])"
)

QUATERNION: Final = ("qw", "qx", "qy", "qz")
VECTOR: Final = ("rx", "ry", "rz")
ANGLES: Final = ("roll", "pitch", "yaw")
# KUKA turns by A about z, by B about the new y, by C about the newest x: by C, B, A about fixed x, y, z, in degrees.
# In capitals, as KUKA writes them: a, b and c may be anything.
KUKA: Final = ("C", "B", "A")
AXES: Final = ("x", "y", "z")
_LEAVES: Final = (*AXES, "w", *QUATERNION, *VECTOR, *ANGLES)
# Other spellings of a last word: what it stands for.
_ALIASES: Final[dict[str, tuple[str, ...]]] = {
    **{f"{head}{axis}": ("position", axis) for head in ("t", "p", "pos", "trans") for axis in AXES},
    **{f"{head}{axis}": ("orientation", axis) for head in ("quat", "ori", "o") for axis in (*AXES, "w")},
    **{f"rot{axis}": ("rot", axis) for axis in (*AXES, "w")},
}


@dataclass(frozen=True)
class Name:
    """A column's name, taken apart.

    Attributes:
        words: what stands before, in lower case.
        leaf: an axis, a component, a number, or the last word.
        unit: the unit it states, or an empty text.
    """

    words: tuple[str, ...]
    leaf: str
    unit: str


def parsed(name: str) -> Name:
    """Return a column's name taken apart: ``actual_TCP_pose_0``, ``field.pose.position.x``, ``posX [mm]``, ``q[3]``."""
    text, unit = name.strip().strip("\"'").lstrip("%#").strip(), ""
    bracket = _BRACKETED.search(text)
    if bracket and bracket[1].lower() in _KNOWN_UNITS:
        text, unit = text[: bracket.start()], bracket[1].lower()
    words = [word if word in KUKA else word.lower() for word in _WORDS.split(text) if word]
    if len(words) > 1 and not unit and words[-1] in _KNOWN_UNITS and not (words[-1] == "m" and words[-2] == "t"):
        unit = words.pop()
    if len(words) > 1 and words[-1].isdecimal() and words[-2] in _LEAVES:
        # x1 y1 z1, x2 y2 z2: the number tells poses apart.
        words = [*words[:-2], words[-1], words[-2]]
    if len(words) > 1 and words[-2:][0] in ("q", "r") and words[-1] in (*AXES, "w"):
        joined = words[-2] + words[-1]
        if joined in _LEAVES:
            words[-2:] = [joined]
    if words and words[-1] in _ALIASES:
        words[-1:] = _ALIASES[words[-1]]
    # Only a last word may be KUKA's: the poses' names A and B are in lower case as all others.
    return Name(tuple(word.lower() for word in words[:-1]), words[-1] if words else "", unit)


def length_unit(names: list[Name]) -> Units | None:
    """Return the unit of length that names state, None if none or several."""
    found = {_LENGTH_UNITS.get(name.unit) for name in names}
    return found.pop() if len(found) == 1 else None


def check_one_unit(where: str, names: list[Name]) -> None:
    """Raise BadInputError if the names of a position state several units of length."""
    stated = [name.unit for name in names if name.unit in _LENGTH_UNITS]
    if len({_LENGTH_UNITS[unit] for unit in stated}) > 1:
        found = ", ".join(f"{'.'.join((*name.words, name.leaf))} in {name.unit or 'none'}" for name in names)
        raise BadInputError(f"demos {where}: the columns of a position must be in one unit, found {found}")


def angle_unit(names: list[Name]) -> Angles | None:
    """Return the unit of angles that names state, None if none or several."""
    found = {_ANGLE_UNITS.get(name.unit) for name in names}
    return found.pop() if len(found) == 1 else None


def clock_unit(name: Name) -> Clock | None:
    """Return the unit of time that a name states, or None."""
    return _CLOCK_UNITS.get(name.unit)


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


OTHER_WORDS: Final = _words(
    "vel velocity velocities speed twist linear angular force wrench torque torques acc accel acceleration covariance"
    " cov std moment effort voltage temperature momentum offset dq ddq qd qdd tau error weight gripper finger"
)
"""A column whose name has one of these words is no pose."""
JOINT_WORDS: Final = _words("q j joint joints jnt qpos")
"""Words of joint angles."""
_POSITION_WORDS: Final = _words("pos position translation trans xyz p")
_QUATERNION_WORDS: Final = _words("orientation orient ori quat quaternion rotation rot q")
_VECTOR_WORDS: Final = _words("rotvec rotvector axisangle aa")
_ANGLE_WORDS: Final = _words("rpy euler theta")
_TURN_WORDS: Final = _QUATERNION_WORDS | _VECTOR_WORDS | _ANGLE_WORDS | _words("vec vector axis angle angles")
_MATRIX_WORDS: Final = _TURN_WORDS | _words("r")
# Rows and columns of a rotation matrix, counted from 1 or 0: r11 r12 … r33.
_ENTRIES: Final = tuple([10 * row + column for row in rows for column in rows] for rows in (range(1, 4), range(3)))
_POSE_WORDS: Final = _words("pose tcp eef ee tool flange cartesian transform tf matrix")


@dataclass(frozen=True)
class PoseColumns:
    """The columns of one pose, by their places; None where the file does not say.

    Attributes:
        name: what stands before the columns' names.
        other: another orientation of the same pose, if there are two.
    """

    name: str
    position: tuple[int, ...] = ()
    turn: tuple[int, ...] = ()
    rotation: RowRotation | None = None
    order: QuaternionOrder | None = None
    units: Units | None = None
    angles: Angles | None = None
    other: "PoseColumns | None" = None

    @property
    def words(self) -> frozenset[str]:
        """The words of its name."""
        return frozenset(self.name.split())


def numbered(known: Sequence[Name]) -> list[tuple[tuple[str, ...], dict[int, int]]]:
    """Return groups of columns that differ in a last number: their words, and places by number from 0."""
    groups: dict[tuple[str, ...], dict[int, int]] = {}
    for place, name in enumerate(known):
        if name.leaf.isdecimal():
            groups.setdefault(name.words, {})[int(name.leaf)] = place
    found = []
    for words, members in groups.items():
        first = min(members)
        if (first in (0, 1) and sorted(members) == list(range(first, first + len(members)))) or (
            sorted(members) in _ENTRIES
        ):
            found.append((words, {index: members[number] for index, number in enumerate(sorted(members))}))
    return found


def poses_of(known: Sequence[Name]) -> list[PoseColumns]:
    """Return the poses that names show."""
    positions: dict[str, PoseColumns] = {}
    turns: dict[str, PoseColumns] = {}
    whole: list[PoseColumns] = []
    by_words: dict[tuple[str, ...], dict[str, int]] = {}
    for place, name in enumerate(known):
        if not name.leaf.isdecimal() and not set(name.words) & OTHER_WORDS:
            by_words.setdefault(name.words, {})[name.leaf] = place
    for words, leaves in by_words.items():
        _lettered(words, leaves, known, positions, turns)
    for words, group in numbered(known):
        if not set(words) & OTHER_WORDS:
            _counted(words, tuple(group.values()), known, positions, turns, whole)
    if len(positions) == 1 and len(turns) == 1 and not whole:
        turns = {next(iter(positions)): next(iter(turns.values()))}
    for owner, found in positions.items():
        turn = turns.get(owner, PoseColumns(owner))
        whole.append(replace(turn, name=owner, position=found.position, units=found.units))
    return whole


def _owner(words: Iterable[str], kinds: frozenset[str]) -> str:
    return " ".join(word for word in words if word not in kinds)


_LETTERED: Final[tuple[tuple[tuple[str, ...], RowRotation], ...]] = (
    (QUATERNION, "quaternion"),
    (VECTOR, "vector"),
    (ANGLES, "angles"),
    (KUKA, "kuka"),
)


def _lettered(
    words: tuple[str, ...],
    leaves: dict[str, int],
    known: Sequence[Name],
    positions: dict[str, PoseColumns],
    turns: dict[str, PoseColumns],
) -> None:
    """Add what columns x y z, w x y z, qw qx qy qz, rx ry rz, roll pitch yaw or KUKA's A B C of one prefix are."""
    turned = bool(set(words) & _TURN_WORDS)
    owner = _owner(words, _TURN_WORDS if turned else _POSITION_WORDS)
    for names, rotation in _LETTERED:
        if not all(leaf in leaves for leaf in names):
            continue
        own = _owner(words, _TURN_WORDS | _POSITION_WORDS)
        found = _turn(own, [leaves[leaf] for leaf in names], rotation, known)
        if names == KUKA and own in turns:
            continue
        turns[own] = replace(turns[owner], other=found) if owner in turns else found
    if not all(leaf in leaves for leaf in AXES):
        return
    if turned and "w" in leaves:
        found = _turn(owner, [leaves[leaf] for leaf in ("w", *AXES)], "quaternion", known)
        turns[owner] = replace(found, other=turns.get(owner))
    elif turned:
        found = _turn(owner, [leaves[leaf] for leaf in AXES], _three(words), known)
        turns[owner] = replace(found, other=turns.get(owner))
    else:
        places = tuple(leaves[leaf] for leaf in AXES)
        positions[owner] = PoseColumns(owner, places, units=_unit(places, known))


def _unit(places: Sequence[int], known: Sequence[Name]) -> Units | None:
    """Return the unit of a position, the first three of some columns."""
    return length_unit([known[place] for place in places[:3]])


def _turn(owner: str, places: Sequence[int], rotation: RowRotation | None, known: Sequence[Name]) -> PoseColumns:
    order: QuaternionOrder | None = "wxyz" if rotation == "quaternion" else None
    angles = angle_unit([known[i] for i in places])
    # Where names say the unit, KUKA's habit says nothing.
    kind: RowRotation | None = "angles" if rotation == "kuka" and angles else rotation
    return PoseColumns(owner, (), tuple(places), kind, order, None, angles)


def _three(words: Iterable[str]) -> RowRotation | None:
    found = set(words)
    if found & _ANGLE_WORDS:
        return "angles"
    return "vector" if found & _VECTOR_WORDS or {"rotation", "vector"} <= found or {"axis", "angle"} <= found else None


def _counted(
    words: tuple[str, ...],
    places: tuple[int, ...],
    known: Sequence[Name],
    positions: dict[str, PoseColumns],
    turns: dict[str, PoseColumns],
    whole: list[PoseColumns],
) -> None:
    """Add what numbered columns of one prefix are: a pose of 6, 7, 12 or 16 numbers, a position, an orientation."""
    found, count, name = set(words), len(places), " ".join(words)
    if count == 16:
        whole.append(PoseColumns(name, places, places, "transform", units=_unit(places, known)))
    elif count in (6, 7) and found & _POSE_WORDS and not found & JOINT_WORDS:
        # UR's TCP pose is documented; others' six numbers may be of either kind.
        six: RowRotation | None = "vector" if "tcp" in found else None
        kind: RowRotation | None = "quaternion" if count == 7 else six
        whole.append(PoseColumns(name, places[:3], places[3:], kind, units=_unit(places, known)))
    elif count == 3 and found & _POSITION_WORDS and not found & _TURN_WORDS:
        positions[_owner(words, _POSITION_WORDS)] = PoseColumns(name, places, units=_unit(places, known))
    elif count == 4 and found & _QUATERNION_WORDS:
        owner = _owner(words, _TURN_WORDS)
        turns[owner] = PoseColumns(name, (), places, "quaternion", other=turns.get(owner))
    elif count == 3 and found & _TURN_WORDS:
        owner = _owner(words, _TURN_WORDS)
        angles = angle_unit([known[i] for i in places])
        turns[owner] = PoseColumns(name, (), places, _three(words), angles=angles, other=turns.get(owner))
    elif count == 9 and found & _MATRIX_WORDS:
        owner = _owner(words, _MATRIX_WORDS)
        turns[owner] = PoseColumns(name, (), places, "matrix", other=turns.get(owner))
