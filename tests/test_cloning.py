"""Behavioural cloning from observation."""

import numpy as np
import torch
from imitation.cloning import Cloning, Noise
from imitation.inferred import Imitator, demonstrated_steps, demonstrated_transitions
from imitation_parts import parameters, short, success

from koopdqn import pose
from koopdqn.tasks.actions import nearest_actions
from koopdqn.tasks.start_frame import STILL, StartFrame

NOISE = Noise(position_m=0.004, rotation_rad=0.05)


def cloned(seed: int = 0, updates: int = 400, frame: StartFrame = STILL, noise: Noise | None = None) -> Imitator:
    cloning = Cloning(short().trajectories, short().cell.task, short().agent, seed, frame, noise)
    cloning.update(updates)
    return Imitator(cloning.policy, cloning.updates)


def test_it_takes_the_demonstrated_actions_where_they_were_taken() -> None:
    shown = demonstrated_transitions(short().trajectories, short().cell.task)
    agreed = (cloned().policy(shown.poses, shown.starts) == shown.actions).mean()
    commonest = np.bincount(shown.actions).max() / len(shown.actions)
    assert agreed > max(0.95, commonest + 0.1)


def test_it_learns_a_short_way_without_acting() -> None:
    learned = cloned()
    assert success(learned.policy) == 1.0
    assert (learned.updates, learned.env_steps) == (400, 0)


def test_with_noise_it_leads_back_from_beside_what_was_shown() -> None:
    task = short().cell.task
    before, after, starts, _ = demonstrated_steps(short().trajectories, task)
    motion = after[:, pose.POSITION] - before[:, pose.POSITION]
    # At right angles to the motion, twice the noise's standard deviation away.
    sideways = np.cross(motion, [0.0, 0.0, 1.0])
    sideways *= 2 * NOISE.position_m / np.linalg.norm(sideways, axis=1, keepdims=True)
    beside = pose.make(before[:, pose.POSITION] + sideways, before[:, pose.QUATERNION])
    back = nearest_actions(beside, after, task)
    agreed = [(cloned(noise=noise).policy(beside, starts) == back).mean() for noise in (None, NOISE)]
    assert agreed[1] > max(0.5, agreed[0] + 0.3)


def test_poses_are_observed_in_the_frame_that_is_given() -> None:
    task = short().cell.task
    frame = StartFrame(task.nominal_start[pose.POSITION], task.goal[pose.POSITION], follows=True)
    learned = cloned(frame=frame)
    shown = demonstrated_transitions(short().trajectories, task, frame)
    assert learned.policy.frame == frame
    assert (learned.policy(shown.poses, shown.starts) == shown.actions).mean() > 0.9
    # The network was taught there, and not where the poses are.
    assert not all(np.array_equal(a, b) for a, b in zip(parameters(learned), parameters(cloned()), strict=True))


def test_the_seed_fixes_every_weight() -> None:
    torch.manual_seed(1)
    first = parameters(cloned(updates=20))
    torch.manual_seed(2)
    again, other = parameters(cloned(updates=20)), parameters(cloned(seed=1, updates=20))
    noisy = [parameters(cloned(updates=20, noise=NOISE)) for _ in range(2)]
    assert all(np.array_equal(a, b) for a, b in zip(*noisy, strict=True))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not all(np.array_equal(a, b) for a, b in zip(first, other, strict=True))
