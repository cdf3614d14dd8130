"""Paths that pass themselves, and controllers that go along them."""

from functools import cache
from itertools import pairwise

import numpy as np
from helpers_shelf import PARTS
from helpers_shown import HORIZONTAL, derivation, recorded, shown

from koopdqn import pose
from koopdqn.paths import arc_lengths, hausdorff, to_step
from koopdqn.pose import Array
from koopdqn.tasks.actions import nearest_actions
from koopdqn.tasks.demonstrated import DemonstratedTask
from koopdqn.tasks.rollout import SUCCESS, Controller, roll_out
from koopdqn.tasks.task import demonstrator_next_poses
from koopdqn.tasks.unfolding import Unfolding
from koopdqn.tasks.workcell import open_workcell

STEP, BY_GOAL = 0.0021, 0.02


def unfolded(trajectories: list[Array]) -> Unfolding | None:
    return Unfolding.of(to_step(trajectories, STEP, 0.1), STEP, BY_GOAL)


def eight(wave: float = 0.0, phase: float = 0.0) -> Array:
    """Return poses (400, 7) along a figure eight of 0.2 m, its crossing passed twice, waved aside by ``wave`` [m]."""
    share = np.linspace(0.13, 1.06, 400)
    across, up = 0.1 * np.sin(2 * np.pi * share), 0.075 * np.sin(4 * np.pi * share)
    left = np.minimum(1.0, 3.0 * (1.06 - share))
    across += wave * left * np.sin(9 * share + phase)
    up += wave * left * np.cos(7 * share + phase)
    across, up = across - across[-1], up - up[-1]
    return pose.make(np.stack([np.full(400, 0.45), across, 0.35 + up], axis=1), HORIZONTAL)


def eights() -> list[Array]:
    return to_step([eight(0.004, phase) for phase in range(5)], STEP, 0.1)


@cache
def unfolding() -> Unfolding:
    found = Unfolding.of(eights(), STEP, BY_GOAL)
    assert found is not None
    return found


@cache
def task() -> DemonstratedTask:
    return derivation(holdout=0).derive(shown(*map(recorded, eights()))).task


def strokes(*corners: float, phase: float = 0.0, wave: float = 0.0) -> Array:
    """Return poses (N, 7) from corner to corner [m] along a line, and away from it by ``wave`` [m]."""
    place = np.concatenate([[corners[0]], *(np.linspace(a, b, 100)[1:] for a, b in pairwise(corners))])
    up = wave * np.sin(np.linspace(0.0, 9.0, len(place)) + phase)
    up -= up[-1]
    return pose.make(np.stack([np.full_like(place, 0.45), place, 0.35 + up], axis=1), HORIZONTAL)


def circle(closed: float, wave: float = 0.0, phase: float = 0.0) -> Array:
    """Return poses (300, 7) once around a circle of 0.14 m, but for its last ``closed`` [m]."""
    angle = np.linspace(0.0, 2 * np.pi - closed / 0.07, 300)
    across, up = 0.07 * np.cos(angle), 0.07 * np.sin(angle)
    left = np.minimum(1.0, 3.0 * np.linspace(1.0, 0.0, 300))
    across += wave * left * np.sin(np.linspace(0.0, 7.0, 300) + phase)
    return pose.make(np.stack([np.full(300, 0.45), across, 0.35 + up], axis=1), HORIZONTAL)


def shapes() -> dict[str, list[Array]]:
    """Return demonstrations that turn back once, or twice, that close, and that come through their goal."""
    phases = range(4)
    return {
        "there and back": [strokes(0.0, 0.2 + 0.004 * k, 0.06, phase=k, wave=0.004) for k in phases],
        "there and back twice": [strokes(0.0, 0.2, 0.0, 0.2 - 0.003 * k, 0.1, phase=k, wave=0.003) for k in phases],
        "closed": [circle(0.003, 0.003, k) for k in phases],
        "through the goal": [
            np.concatenate([strokes(-0.1, circle(0.0)[0, 1], phase=k, wave=0.003), circle(0.0, 0.003, k)[1:]])
            for k in phases
        ],
    }


@cache
def shaped(name: str) -> DemonstratedTask:
    return derivation(holdout=0).derive(shown(*map(recorded, shapes()[name]))).task


def one_by_one(found: Unfolding, rows: Array) -> Array:
    """Return the starts (N, 7) that count at poses (N, 7), told from pose to pose as an episode goes on."""
    told = [rows[0]]
    for each in rows[1:]:
        told.append(found.onward(each[None], told[-1][None])[0])
    return np.array(told)


def all_the_way(controller: Controller, shown_task: DemonstratedTask) -> None:
    """Assert that a controller passes all of the path, what it passes twice too, and in no circle."""
    cell, start = open_workcell(shown_task, PARTS.arm), shown_task.nominal_start
    joints = cell.reachability.enter(start).joints
    assert joints is not None
    begun = start[None], joints[None]
    (episode,) = roll_out(controller, shown_task, cell.reachability, *begun, 800, cut_circles=True)
    assert episode.outcome == SUCCESS
    shown_path = shown_task.trajectories[0]
    assert hausdorff(episode.poses[:, :3], shown_path[:, :3]) < 0.03
    assert arc_lengths(episode.poses[:, :3])[-1] > 0.9 * arc_lengths(shown_path[:, :3])[-1]


def person_of(shown_task: DemonstratedTask) -> Controller:
    return lambda poses, starts: nearest_actions(poses, demonstrator_next_poses(shown_task, poses, starts), shown_task)
