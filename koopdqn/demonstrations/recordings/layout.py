"""What each column of a table is, by the columns' names and by what is declared."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from koopdqn.demonstrations.recordings.names import (
    ANGLES,
    AXES,
    JOINT_WORDS,
    KUKA,
    OTHER_WORDS,
    QUATERNION,
    VECTOR,
    Name,
    PoseColumns,
    angle_unit,
    check_one_unit,
    clock_unit,
    numbered,
    parsed,
    poses_of,
)
from koopdqn.demonstrations.recordings.recording import Angles, Clock, ImportSettings
from koopdqn.errors import BadInputError

_COMMANDED: Final = ("target", "desired", "command", "commanded", "cmd", "goal", "reference", "ref", "setpoint", "des")
# Of joints: q_d, and the controller's q_c.
_COMMANDED_LAST: Final = ("d", "c")
_MEASURED: Final = ("actual", "measured", "meas", "current", "observed", "real")
_TIMES: Final = ("t", "time", "timestamp", "stamp", "elapsed", "clock", "timestep", "seconds", "secs")
# A whole second and what is over it, in two columns.
_SECONDS: Final = ("secs", "sec")
_NANOSECONDS: Final = ("nsecs", "nanosec", "nsec")
# Words of a time that is none of the clock's.
_SPANS: Final = {"duration", "lifetime", "start", "timeout", "period"}
_DEMOS: Final = ("demo", "demonstration", "episode", "trajectory", "traj", "trial")
_UNNAMED: Final = ""
# What the pose is called whose columns have no prefix.
_FIRST: Final = "1"


@dataclass(frozen=True)
class Layout:
    """What the columns of a table are, by their places.

    Attributes:
        pose: the pose's columns; None where there are joints alone.
        time: one column, or two of seconds and nanoseconds; none if empty.
        clock: the unit of time, None where the names do not say.
        demo: the column that tells demonstrations apart, or None.
        joints: the joints' columns, base first.
        tool: six columns of the tool's pose in the flange; none if empty.
        reasons: why, a line each.
    """

    pose: PoseColumns | None
    time: tuple[int, ...] = ()
    clock: Clock | None = None
    demo: int | None = None
    joints: tuple[int, ...] = ()
    joint_angles: Angles | None = None
    tool: tuple[int, ...] = ()
    reasons: tuple[str, ...] = ()


def layout_of(where: str, names: Sequence[str], declared: ImportSettings) -> Layout:
    """Return what the columns of a file, for messages, are, by their names and by what is declared.

    Raises:
        BadInputError: there is no pose and no joints, or several poses and none is chosen.
    """
    if isinstance(declared.columns, tuple):
        if len(declared.columns) != len(names):
            raise BadInputError(
                f"import.columns: must name each of the {len(names)} columns of {where}, found {len(declared.columns)}"
            )
        # The roles are names that are recognised as they stand.
        plain, names = declared.model_copy(update={"columns": None}), list(declared.columns)
        return layout_of(where, names, plain)
    if declared.columns:
        names = _renamed(where, names, declared.columns)
    known = [parsed(name) for name in _without_twins(names)]
    time, clock, why_time = _time_of(names, known)
    if "t" in (declared.columns or {}):
        place = next(i for i, name in enumerate(known) if (name.words, name.leaf) == ((), "t"))
        time, clock, why_time = (place,), clock_unit(known[place]), ["time from the declared column"]
    demo = next((i for i, name in enumerate(names) if _is_demo(known[i])), None)
    tool = next((tuple(g.values()) for w, g in numbered(known) if w[-2:] == ("tcp", "offset") and len(g) == 6), ())
    poses = poses_of(known)
    pose, why_pose = _chosen(where, poses, declared)
    joints = _joints_of(where, known, declared, alone=pose is None)
    if pose is not None:
        check_one_unit(where, [known[place] for place in pose.position[:3]])
    if pose is None and not joints:
        found = ", ".join(names[:20]) + (" …" if len(names) > 20 else "")
        raise BadInputError(
            f"demos {where}: must have columns of a pose such as x y z and qw qx qy qz, found none recognised among"
            f" {found}; import.columns={{x: NAME, …}} says which they are, by name or place from 0,"
            " import.columns=[x,y,…] in their order"
        )
    used = (*time, *(() if demo is None else (demo,)), *((*pose.position, *pose.turn) if pose else joints))
    if len(poses) < 2:
        # Of two poses a row the names of one repeat those of the other; alone, a second x is an error.
        _check_single(where, names, used)
    reasons = list(why_pose)
    if pose is not None:
        reasons.append(f"position from {listed(names, pose.position)}")
        if pose.turn:
            reasons.append(f"orientation from {listed(names, pose.turn)}")
    elif joints:
        reasons.append(f"joints from {listed(names, joints)}")
    reasons += why_time + ([f"demonstrations by column {names[demo]}"] if demo is not None else [])
    return Layout(pose, time, clock, demo, joints, angle_unit([known[i] for i in joints]), tool, tuple(reasons))


def shows_motion(names: Sequence[str]) -> bool:
    """Return whether names show a pose or joints."""
    known = [parsed(name) for name in _without_twins(names)]
    return bool(poses_of(known) or _joint_sets(known))


def _renamed(where: str, names: Sequence[str], roles: dict[str, str]) -> list[str]:
    """Return the names, those of declared columns being their roles; what bore a role's name by chance is put aside."""
    folded = [name.strip().lower() for name in names]
    known = [parsed(name) for name in folded]
    chance = [
        name in roles or (not each.words and each.leaf in roles) for name, each in zip(folded, known, strict=True)
    ]
    result = ["_" if aside else name for aside, name in zip(chance, names, strict=True)]
    if {"x", "y", "z"} & set(roles):
        # A declared pose is the only one.
        result = ["_" if _is_pose_part(parsed(name)) else name for name in result]
    for role, name in roles.items():
        key = name.strip().lower()
        place = folded.index(key) if key in folded else int(key) if key.isdecimal() else -1
        if not 0 <= place < len(names):
            raise BadInputError(f"import.columns: {role} must name a column of {where}, found {name!r}")
        # A unit that the name states stays the column's.
        unit = parsed(names[place]).unit
        result[place] = f"{role} [{unit}]" if unit else role
    return result


def _check_single(where: str, names: Sequence[str], used: Sequence[int]) -> None:
    twice = [names[place] for place in used if list(names).count(names[place]) > 1]
    if twice:
        raise BadInputError(f"demos {where}: must name every column once, found two named {twice[0]}")


def _is_pose_part(name: Name) -> bool:
    return name.leaf in (*AXES, "w", *QUATERNION, *VECTOR, *ANGLES, *KUKA) or name.leaf.isdecimal()


def _without_twins(names: Sequence[str]) -> Iterator[str]:
    """Yield the names; the second of one name gets a number, as two poses of a row have it."""
    seen: dict[str, int] = {}
    for name in names:
        count = seen[name] = seen.get(name, 0) + 1
        yield name if count == 1 or name == _UNNAMED else f"{count}.{name}"


def _whole(name: Name) -> str:
    return "_".join((*name.words, name.leaf))


def _is_demo(name: Name) -> bool:
    whole = _whole(name)
    return any(whole in (word, f"{word}_index", f"{word}_id") for word in _DEMOS)


def listed(names: Sequence[str], places: Iterable[int]) -> str:
    """Return the names of columns at some places, of more than four the first and the last."""
    shown = [names[place] for place in places]
    return f"{shown[0]} … {shown[-1]}" if len(shown) > 4 else " ".join(shown)


def _time_of(names: Sequence[str], known: Sequence[Name]) -> tuple[tuple[int, ...], Clock | None, list[str]]:
    """Return the places of the time, its unit and why."""
    # What a message was stamped with is nearer to the motion than when it was written down.
    found = [i for i, name in enumerate(known) if name.leaf in _TIMES and not set(name.words) & OTHER_WORDS]
    pair = _whole_and_rest(known)
    if pair and ("stamp" in _spelled(known[pair[0]]) or set(found) <= set(pair)):
        return pair, "s", [f"time from {listed(names, pair)}"]
    found.sort(key=lambda i: (known[i].leaf != "stamp", len(known[i].words), _TIMES.index(known[i].leaf)))
    if not found:
        return (), None, []
    echoed = any(name.words[:1] == ("field",) for name in known)
    clock = clock_unit(known[found[0]]) or ("ns" if echoed else None)
    why = f"time from {names[found[0]].strip()}" + (", in ns as rostopic echo -p writes it" if echoed else "")
    return (found[0],), clock, [why]


def _spelled(name: Name) -> tuple[str, ...]:
    """Return all words of a name, one that was taken for a unit too."""
    return (*name.words, name.leaf, *([name.unit] if name.unit else []))


def _whole_and_rest(known: Sequence[Name]) -> tuple[int, ...]:
    """Return the places of whole seconds and of the nanoseconds over them; none if empty. A stamp comes first."""
    spelled = [_spelled(name) for name in known]
    pairs = [
        (bool(set(words) & set(_COMMANDED)), "stamp" not in words, place, spelled.index((*words[:-1], rest)))
        for place, words in enumerate(spelled)
        for rest in _NANOSECONDS
        if words[-1] in _SECONDS and (*words[:-1], rest) in spelled and not set(words) & _SPANS
    ]
    return min(pairs)[2:] if pairs else ()


def _joints_of(where: str, known: Sequence[Name], declared: ImportSettings, *, alone: bool) -> tuple[int, ...]:
    """Return the places of the joints; where they stand ``alone``, of several sets the one that is declared.

    Raises:
        BadInputError: there are several sets and none, or no single one, is declared.
    """
    sets = _joint_sets(known)
    if len(sets) > 1 and alone:
        asked = set(parsed(f"{declared.pose}_0").words) if declared.pose else set()
        named = [words for words in sets if asked and asked <= set(words)]
        if len(named) != 1:
            valid = ", ".join(" ".join(words) for words in sets)
            raise BadInputError(
                f"import.pose: must name one of the {len(sets)} sets of joints of {where}, found"
                f" {declared.pose or 'nothing'}; valid: {valid}"
            )
        return sets[named[0]]
    return next(iter(sets.values()), ())


def _joint_sets(known: Sequence[Name]) -> dict[tuple[str, ...], tuple[int, ...]]:
    """Return the places of sets of joints by their words: measured ones, else those not commanded, else all."""
    sets = {}
    for words, group in numbered(known):
        motor = "current" in words and words[0] != "current"
        if set(words) & JOINT_WORDS and not set(words) & OTHER_WORDS and not motor and len(group) in (6, 7):
            sets[words] = tuple(group.values())
    free = {words: sets[words] for words in sets if not (set(words) & set(_COMMANDED) or words[-1] in _COMMANDED_LAST)}
    measured = {words: free[words] for words in free if set(words) & set(_MEASURED)}
    return measured or free or sets


def _chosen(
    where: str, poses: Sequence[PoseColumns], declared: ImportSettings
) -> tuple[PoseColumns | None, tuple[str, ...]]:
    """Return the pose that is meant, and why it and no other."""
    if declared.pose is not None and poses:
        if declared.pose == _FIRST and any(not each.name for each in poses):
            return next(each for each in poses if not each.name), (f"pose {_FIRST}, as declared",)
        asked = [word for word in parsed(declared.pose + "_x").words if word]
        named = [each for each in poses if set(asked) <= each.words] or [
            each for each in poses if declared.pose.lower() in each.name
        ]
        exact = [each for each in named if each.name == " ".join(asked)]
        if len(exact or named) != 1:
            raise BadInputError(
                f"import.pose: must name one pose of {where}, found {len(named)} for {declared.pose!r};"
                f" valid: {_names(poses)}"
            )
        return (exact or named)[0], (f"pose {declared.pose}, as declared",)
    left = [each for each in poses if each.turn] or list(poses)
    reason: tuple[str, ...] = ()
    if len(left) > 1:
        rest = [each for each in left if not _is_commanded(each.words)]
        measured = [each for each in rest if each.words.intersection(_MEASURED)]
        kept = measured if len(measured) == 1 else rest
        if len(kept) == 1:
            others = ", ".join(_shown(each) for each in left if each is not kept[0])
            reason = (f"pose {_shown(kept[0])}: measured, where {others} is not",)
            left = kept
    if len(left) > 1:
        raise BadInputError(f"import.pose: must name which pose of {where} to read; valid: {_names(left)}")
    return (left[0] if left else None), reason


def _is_commanded(words: frozenset[str]) -> bool:
    # Franka writes the commanded and the desired pose as O_T_EE_c and O_T_EE_d.
    return bool(words.intersection(_COMMANDED)) or bool({"t", "ee"} <= words and words & {"c", "d"})


def _shown(each: PoseColumns) -> str:
    return each.name.replace(" ", "_") or _FIRST


def _names(poses: Sequence[PoseColumns]) -> str:
    return ", ".join(_shown(each) for each in poses)
