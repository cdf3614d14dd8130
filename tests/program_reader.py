"""Reads robot programs back without koopdqn: text to joint angles, and these to poses by the maker's DH table."""

import json
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

Array = NDArray[np.float64]

UR5_TABLE = (
    (0.089159, 0.0, math.pi / 2),
    (0.0, -0.425, 0.0),
    (0.0, -0.39225, 0.0),
    (0.10915, 0.0, math.pi / 2),
    (0.09465, 0.0, -math.pi / 2),
    (0.0823, 0.0, 0.0),
)
"""d [m], a [m] and α [rad] of the UR5's joints."""


@dataclass(frozen=True)
class Timed:
    """Joint angles (N, 6) [rad] at times (N,) [s]."""

    times: Array
    joints: Array


def transforms(joints: Array, table: tuple[tuple[float, float, float], ...] = UR5_TABLE) -> Array:
    """Return the flange's transforms (N, 4, 4): ∏ Rz(θ) Tz(d) Tx(a) Rx(α)."""
    result = np.tile(np.eye(4), (len(joints), 1, 1))
    for theta, (d, a, alpha) in zip(joints.T, table, strict=True):
        link = np.zeros((len(joints), 4, 4))
        ct, st, ca, sa = np.cos(theta), np.sin(theta), math.cos(alpha), math.sin(alpha)
        link[:, 0] = np.stack([ct, -st * ca, st * sa, a * ct], axis=1)
        link[:, 1] = np.stack([st, ct * ca, -ct * sa, a * st], axis=1)
        link[:, 2] = [0.0, sa, ca, d]
        link[:, 3, 3] = 1.0
        result = result @ link
    return result


def read_servoj(path: Path) -> tuple[Array, Timed]:
    """Return the angles (6,) of ``movej`` and the stream of ``servoj``, which begins there."""
    number = r"-?\d+(?:\.\d+)?(?:e-?\d+)?"
    angles = rf"\[({number}(?:, {number}){{5}})\]"
    text = path.read_text(encoding="utf-8")
    starts = re.findall(rf"^  movej\({angles}, a={number}, v={number}\)$", text, re.MULTILINE)
    stream = re.findall(
        rf"^  servoj\({angles}, t=({number}), lookahead_time={number}, gain={number}\)$", text, re.MULTILINE
    )
    assert len(starts) == 1
    assert text.count("servoj(") == len(stream)
    first = np.array([float(cell) for cell in starts[0].split(", ")])
    rows = [first, *(np.array([float(cell) for cell in cells.split(", ")]) for cells, _ in stream)]
    times = np.cumsum([0.0, *(float(period) for _, period in stream)])
    return first, Timed(times, np.array(rows))


def read_movep(path: Path) -> tuple[Array, Array, Array]:
    """Return the angles (6,) of ``movej``, and of each ``movep`` x y z [m], rotation vector [rad] (M, 6) and blend."""
    text = path.read_text(encoding="utf-8")
    (start,) = re.findall(r"^  movej\(\[(.*?)\], ", text, re.MULTILINE)
    lines = re.findall(r"^  movep\(p\[(.*?)\], a=(.*?), v=(.*?), r=(.*?)\)$", text, re.MULTILINE)
    assert text.count("movep(") == len(lines) > 1
    assert all(float(a) > 0 and float(v) > 0 for _, a, v, _ in lines)
    poses = np.array([[float(cell) for cell in cells.split(", ")] for cells, *_ in lines])
    return np.array([float(cell) for cell in start.split(", ")]), poses, np.array([float(line[3]) for line in lines])


def read_joint_trajectory(path: Path) -> tuple[list[str], Timed, Timed, Timed]:
    """Return the joints' names, and angles, speeds and accelerations with their times."""
    text = path.read_text(encoding="utf-8")
    message: dict[str, Any] = json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)
    points = message["points"]
    times = np.array([point["time_from_start"]["sec"] + 1e-9 * point["time_from_start"]["nanosec"] for point in points])
    rows = {
        name: Timed(times, np.array([point[name] for point in points], dtype=float))
        for name in ("positions", "velocities", "accelerations")
    }
    return message["joint_names"], rows["positions"], rows["velocities"], rows["accelerations"]
