"""One motion written as laboratories write it."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.recordings.load import load
from koopdqn.demonstrations.recordings.recording import NOTHING, ImportSettings
from koopdqn.pose import Array
from koopdqn.robot.arm import Arm
from koopdqn.settings import validate

HZ: Final = 50.0
ROWS: Final = 60
TIMES: Final[Array] = np.arange(ROWS) / HZ


def motion(offset: float = 0.0) -> Array:
    """Return poses (60, 7): an arc through the workspace that turns past half a turn, where signs flip."""
    share = np.linspace(0.0, 1.0, ROWS)[:, None]
    position = np.hstack([0.35 + 0.1 * share, offset - 0.2 + 0.4 * share, 0.3 + 0.1 * np.sin(np.pi * share)])
    return pose.make(position, pose.from_rotation_vector((2.6 + 1.0 * share) * np.array([0.6, 0.8, 0.0])))


POSES: Final = motion()
QUATERNION: Final[Array] = POSES[:, 3:]
XYZW: Final[Array] = POSES[:, [4, 5, 6, 3]]
VECTOR: Final[Array] = pose.to_rotation_vector(QUATERNION)
ANGLES: Final[Array] = pose.to_roll_pitch_yaw(QUATERNION)
MATRICES: Final[Array] = np.zeros((ROWS, 4, 4))
MATRICES[:, :3, :3] = pose.to_matrix(QUATERNION)
MATRICES[:, :3, 3] = POSES[:, :3]
MATRICES[:, 3, 3] = 1.0


def joints_along(arm: Arm) -> Array:
    """Return joint angles (60, 6) [rad] that follow the motion."""
    found = [np.asarray(arm.solutions(POSES[0])[0])]
    for each in POSES[1:]:
        result = arm.inverse(each, found[-1])
        assert result.success
        found.append(np.asarray(result.joints))
    return np.array(found)


def written(path: Path, names: str | None, *columns: Array, delimiter: str = ",", form: str = "%.9f") -> Path:
    """Write columns as text below a header of names, which blanks separate; without one if None."""
    values = np.column_stack(columns)
    lines = [] if names is None else [delimiter.join(names.split())]
    lines += [delimiter.join(form % value for value in row) for row in values]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def declared(fields: Mapping[str, Any]) -> ImportSettings:
    """Return declarations."""
    return validate({**NOTHING.model_dump(), **fields}, ImportSettings, "import")


def poses_in(path: Path, arm: Arm | None = None, **fields: Any) -> list[Array]:
    """Return the poses of every demonstration in a file."""
    return [item.poses for item in load(path, declared(fields), arm).items]


def same(found: Array, expected: Array, within: float = 1e-6) -> None:
    """Assert that poses are the same motion."""
    assert found.shape == expected.shape
    assert pose.position_distance(found, expected).max() < within
    assert pose.rotation_distance(found, expected).max() < 10 * within


def numbered(name: str, count: int) -> str:
    """Return a header of numbered columns."""
    return " ".join(f"{name}_{index}" for index in range(count))


def joined(parts: Sequence[str]) -> str:
    """Return one header of several."""
    return " ".join(parts)
