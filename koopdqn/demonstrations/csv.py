"""Demonstrations written as CSV, one sample a row; :mod:`koopdqn.demonstrations.recordings` reads it and any other."""

from collections.abc import Sequence
from io import StringIO
from pathlib import Path
from typing import Final, Literal

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.files import write_text
from koopdqn.settings import Settings

Rotation = Literal["quaternion", "vector", "angles"]
"""Orientation in a CSV file: unit quaternion, rotation vector, or roll, pitch and yaw."""

ROTATIONS: Final[dict[Rotation, tuple[str, ...]]] = {
    "quaternion": ("qw", "qx", "qy", "qz"),
    "vector": ("rx", "ry", "rz"),
    "angles": ("roll", "pitch", "yaw"),
}
"""The columns of each, angles in radians."""
COLUMNS: Final = ("demo", "t", "x", "y", "z")
"""The columns before them: the demonstration, time [s], and position [m] of the flange in the arm's base."""


class ExportSettings(Settings):
    """How demonstrations are written as CSV."""

    rotation: Rotation = Field(description="unit quaternion, rotation vector, or roll, pitch and yaw")


def is_own(names: Sequence[str]) -> bool:
    """Return whether the names of a file's columns are those that :func:`write_csv` writes, in their order."""
    return any(tuple(names) == (*COLUMNS, *columns) for columns in ROTATIONS.values())


def write_csv(path: Path, demonstrations: Sequence[Demonstration], rotation: Rotation = "quaternion") -> None:
    """Write demonstrations with all digits and without joint angles."""
    lines = StringIO()
    lines.write(",".join((*COLUMNS, *ROTATIONS[rotation])) + "\n")
    for index, item in enumerate(demonstrations):
        turned = item.poses[:, pose.QUATERNION]
        if rotation != "quaternion":
            turned = pose.to_rotation_vector(turned) if rotation == "vector" else pose.to_roll_pitch_yaw(turned)
        for row in np.concatenate([item.times[:, None], item.poses[:, pose.POSITION], turned], axis=1).tolist():
            lines.write(",".join([str(index), *map(repr, row)]) + "\n")
    write_text(path, lines.getvalue())
