"""Column names: what a name says of its column."""

import re
from dataclasses import dataclass
from typing import Final

from koopdqn.demonstrations.recordings.declared import Angles, Clock, Units
from koopdqn.errors import BadInputError

_UNITS: Final[dict[str, Units]] = {"m": "m", "meter": "m", "metre": "m", "meters": "m", "cm": "cm", "mm": "mm"}
_ANGLES: Final[dict[str, Angles]] = {"rad": "rad", "deg": "deg", "°": "deg", "degree": "deg", "degrees": "deg"}
_CLOCKS: Final[dict[str, Clock]] = {
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
_KNOWN_UNITS: Final = {**_UNITS, **_ANGLES, **_CLOCKS}
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
    return Name(tuple(words[:-1]), words[-1] if words else "", unit)


def length_unit(names: list[Name]) -> Units | None:
    """Return the unit of length that names state, None if none or several."""
    found = {_UNITS.get(name.unit) for name in names}
    return found.pop() if len(found) == 1 else None


def check_one_unit(where: str, names: list[Name]) -> None:
    """Raise BadInputError if the names of a position state several units of length."""
    stated = [name.unit for name in names if name.unit in _UNITS]
    if len({_UNITS[unit] for unit in stated}) > 1:
        found = ", ".join(f"{'.'.join((*name.words, name.leaf))} in {name.unit or 'none'}" for name in names)
        raise BadInputError(f"demos {where}: the columns of a position must be in one unit, found {found}")


def angle_unit(names: list[Name]) -> Angles | None:
    """Return the unit of angles that names state, None if none or several."""
    found = {_ANGLES.get(name.unit) for name in names}
    return found.pop() if len(found) == 1 else None


def clock_unit(name: Name) -> Clock | None:
    """Return the unit of time that a name states, or None."""
    return _CLOCKS.get(name.unit)
