"""The poses that column names show: positions and orientations of one prefix each."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from koopdqn.demonstrations.recordings.declared import Angles, QuaternionOrder, Units
from koopdqn.demonstrations.recordings.names import (
    ANGLES,
    AXES,
    KUKA,
    QUATERNION,
    VECTOR,
    Name,
    angle_unit,
    length_unit,
)
from koopdqn.demonstrations.recordings.recording import RowRotation


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


OTHER: Final = _words(
    "vel velocity velocities speed twist linear angular force wrench torque torques acc accel acceleration covariance"
    " cov std moment effort voltage temperature momentum offset dq ddq qd qdd tau error weight gripper finger"
)
"""A column whose name has one of these words is no pose."""
JOINT_WORDS: Final = _words("q j joint joints jnt qpos")
"""Words of joint angles."""
_POSITION: Final = _words("pos position translation trans xyz p")
_QUATERNION: Final = _words("orientation orient ori quat quaternion rotation rot q")
_VECTOR: Final = _words("rotvec rotvector axisangle aa")
_ANGLES: Final = _words("rpy euler theta")
_TURN: Final = _QUATERNION | _VECTOR | _ANGLES | _words("vec vector axis angle angles")
_POSE: Final = _words("pose tcp eef ee tool flange cartesian transform tf matrix")


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
        if first in (0, 1) and sorted(members) == list(range(first, first + len(members))):
            found.append((words, {number - first: members[number] for number in sorted(members)}))
    return found


def poses_of(known: Sequence[Name]) -> list[PoseColumns]:
    """Return the poses that names show."""
    positions: dict[str, PoseColumns] = {}
    turns: dict[str, PoseColumns] = {}
    whole: list[PoseColumns] = []
    by_words: dict[tuple[str, ...], dict[str, int]] = {}
    for place, name in enumerate(known):
        if not name.leaf.isdecimal() and not set(name.words) & OTHER:
            by_words.setdefault(name.words, {})[name.leaf] = place
    for words, leaves in by_words.items():
        _lettered(words, leaves, known, positions, turns)
    for words, group in numbered(known):
        if not set(words) & OTHER:
            _counted(words, tuple(group.values()), known, positions, turns, whole)
    if len(positions) == 1 and len(turns) == 1 and not whole:
        turns = {next(iter(positions)): next(iter(turns.values()))}
    for owner, found in positions.items():
        turn = turns.get(owner, PoseColumns(owner))
        whole.append(replace(turn, name=owner, position=found.position, units=found.units))
    return whole


def _owner(words: Iterable[str], kinds: frozenset[str]) -> str:
    return " ".join(word for word in words if word not in kinds)


def _lettered(
    words: tuple[str, ...],
    leaves: dict[str, int],
    known: Sequence[Name],
    positions: dict[str, PoseColumns],
    turns: dict[str, PoseColumns],
) -> None:
    """Add what columns x y z, w x y z, qw qx qy qz, rx ry rz, roll pitch yaw or KUKA's A B C of one prefix are."""
    turned = bool(set(words) & _TURN)
    owner = _owner(words, _TURN if turned else _POSITION)
    for names, rotation in ((QUATERNION, "quaternion"), (VECTOR, "vector"), (ANGLES, "angles"), (KUKA, "angles")):
        if not all(leaf in leaves for leaf in names):
            continue
        own = _owner(words, _TURN | _POSITION)
        found = _turn(own, [leaves[leaf] for leaf in names], rotation, known)
        if names == KUKA:
            if own in turns:
                continue
            found = replace(found, angles=found.angles or "deg")
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


def _turn(owner: str, places: Sequence[int], rotation: str | None, known: Sequence[Name]) -> PoseColumns:
    kind: RowRotation | None = rotation  # type: ignore[assignment]  # one of the names above
    order: QuaternionOrder | None = "wxyz" if kind == "quaternion" else None
    return PoseColumns(owner, (), tuple(places), kind, order, None, angle_unit([known[i] for i in places]))


def _three(words: Iterable[str]) -> RowRotation | None:
    found = set(words)
    if found & _ANGLES:
        return "angles"
    return "vector" if found & _VECTOR or {"rotation", "vector"} <= found or {"axis", "angle"} <= found else None


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
    elif count in (6, 7) and found & _POSE and not found & JOINT_WORDS:
        # UR's TCP pose is documented; others' six numbers may be of either kind.
        six: RowRotation | None = "vector" if "tcp" in found else None
        kind: RowRotation | None = "quaternion" if count == 7 else six
        whole.append(PoseColumns(name, places[:3], places[3:], kind, units=_unit(places, known)))
    elif count == 3 and found & _POSITION and not found & _TURN:
        positions[_owner(words, _POSITION)] = PoseColumns(name, places, units=_unit(places, known))
    elif count == 4 and found & _QUATERNION:
        owner = _owner(words, _TURN)
        turns[owner] = PoseColumns(name, (), places, "quaternion", other=turns.get(owner))
    elif count == 3 and found & _TURN:
        owner = _owner(words, _TURN)
        angles = angle_unit([known[i] for i in places])
        turns[owner] = PoseColumns(name, (), places, _three(words), angles=angles, other=turns.get(owner))
    elif count == 9 and found & _TURN:
        owner = _owner(words, _TURN)
        turns[owner] = PoseColumns(name, (), places, "matrix", other=turns.get(owner))
