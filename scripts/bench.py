"""Measures koopdqn's speed on this machine and prints a table: `make bench`.

Every figure is the median of several repeats in one process, except the start-up, which is a whole process.
"""

import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import yaml
from dm_control import mjcf
from dm_control.utils.inverse_kinematics import qpos_from_site_pose
from rich.console import Console
from rich.table import Table

from koopdqn.config.resources import asset_path, conf_dir
from koopdqn.config.settings import load_settings, validate
from koopdqn.demonstrations.generator import DemonstrationSettings, generate
from koopdqn.dqn.learner import Learner
from koopdqn.dqn.observation import observe, size
from koopdqn.dqn.replay import ReplayBuffer, Transitions
from koopdqn.dqn.settings import AgentSettings
from koopdqn.environment.reward import IntentReward, RewardSettings
from koopdqn.intent.fitting import agent_steps, fit
from koopdqn.intent.model import IntentSettings
from koopdqn.intent.trust import TrustSettings
from koopdqn.robot.ur import URArm
from koopdqn.tasks.shelf import ShelfTask
from koopdqn.workcell import open_workcell

REPEATS = 7


@dataclass(frozen=True)
class Row:
    """One line of the table: what was measured, its median, and what it is a figure per."""

    what: str
    median: str
    note: str


def median_seconds(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Return the median time [s] of a piece of work, after one run to warm up."""
    work()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def group(name: str) -> dict[str, object]:
    """Return a config group's option, as its YAML file has it."""
    content: dict[str, object] = yaml.safe_load((conf_dir() / f"{name}.yaml").read_text(encoding="utf-8"))
    return content


def kinematics_rows(arm: URArm, poses: np.ndarray, joints: np.ndarray) -> list[Row]:
    """Return the inverse kinematics' time beside dm_control's, on the same poses and seeds, in this process."""
    seeds = np.vstack([joints[:1], joints[:-1]])

    def ours() -> None:
        for pose, seed in zip(poses, seeds, strict=True):
            arm.inverse(pose, seed)

    physics = mjcf.Physics.from_xml_string(asset_path(arm.asset).read_text(encoding="utf-8"))

    def peer() -> None:
        for pose, seed in zip(poses, seeds, strict=True):
            physics.data.qpos[:] = seed
            qpos_from_site_pose(physics, arm.flange_site, pose[:3], pose[3:], inplace=True, tol=1e-9)

    mine, other = median_seconds(ours) / len(poses), median_seconds(peer, 3) / len(poses)
    return [
        Row("inverse kinematics, closed form", f"{mine * 1e6:.1f} µs", "a call, along a path of 2 mm steps"),
        Row("the same by dm_control's qpos_from_site_pose", f"{other * 1e6:.1f} µs", f"{other / mine:.1f} times ours"),
    ]


def learning_rows(task: ShelfTask, arm: URArm) -> list[Row]:
    """Return the times of the stages of learning."""
    workcell = open_workcell(task, arm)
    settings = DemonstrationSettings(count=5, speed_m_s=0.1, pace_variation=0.3, sample_seconds=0.02)
    make = lambda: generate(task, workcell.reachability, settings, 0)  # noqa: E731 (one expression, used twice)
    demonstrations = make().demonstrations
    intent = load_settings(group("intent/fourier"), IntentSettings, "intent")
    trust = load_settings(group("trust/tube"), TrustSettings, "trust")
    agent = load_settings(group("agent/fast"), AgentSettings, "agent")
    root = group("config")
    reward_settings = validate(root["reward"], RewardSettings, "reward")  # type: ignore[arg-type]  # a YAML mapping
    fitted = fit(demonstrations, task, intent, trust)
    reward = IntentReward(task, fitted.model, fitted.trust, reward_settings)
    trajectories = agent_steps(demonstrations, task)
    states = np.concatenate(trajectories)
    batch = states[np.random.default_rng(0).integers(len(states), size=agent.episodes_at_once)]
    item = demonstrations.items[0]
    assert item.joints is not None
    pairs = list(zip(item.poses, item.joints, strict=True))

    def moves() -> None:
        for pose, joints in pairs:
            workcell.reachability.move(pose, joints)

    rng = np.random.default_rng(0)
    torch.set_num_threads(1)
    learner = Learner(size(task), agent, rng)
    replay = ReplayBuffer(10_000, size(task))
    seen = observe(states, task)
    flags = np.zeros(len(seen), dtype=bool)
    actions = rng.integers(10, size=len(seen))
    replay.add(Transitions(seen, actions, np.ones(len(seen), np.float32), seen, flags, flags, flags))
    return [
        Row("five demonstrations", f"{median_seconds(make, 3):.2f} s", "on the arm, checked for collisions"),
        Row(
            "fitting, cross-validated",
            f"{median_seconds(lambda: fit(demonstrations, task, intent, trust), 3):.2f} s",
            "",
        ),
        Row(
            "one step of the arm",
            f"{median_seconds(moves) / len(pairs) * 1e6:.1f} µs",
            "inverse kinematics and collisions",
        ),
        Row(
            "judging all ten actions",
            f"{median_seconds(lambda: reward.judge(batch, np.zeros(len(batch), dtype=int))) / len(batch) * 1e6:.1f} µs",
            f"a state, {len(batch)} at once",
        ),
        Row(
            "one update of the network",
            f"{median_seconds(lambda: learner.update(replay.sample(rng, agent.batch))) * 1e3:.2f} ms",
            f"batch {agent.batch}, one thread",
        ),
    ]


def startup_row() -> Row:
    """Return the time of `koopdqn --help` as a whole process."""
    command = [str(Path(sys.executable).with_name("koopdqn")), "--help"]
    seconds = median_seconds(lambda: subprocess.run(command, check=True, capture_output=True))
    return Row("koopdqn --help", f"{seconds:.2f} s", "a whole process")


def main() -> None:
    """Measure and print."""
    arm = load_settings(group("robot/ur5"), URArm, "robot")
    task = load_settings(group("task/shelf"), ShelfTask, "task")
    start = task.nominal_start
    poses = task.demonstrator.roll_out(start, 1000)
    joints = [np.array(arm.solutions(start)[0])]
    for pose in poses[1:]:
        joints.append(np.array(arm.inverse(pose, joints[-1]).joints))
    table = Table("what", "median", "note", title="koopdqn on this machine")
    for row in [startup_row(), *kinematics_rows(arm, poses, np.array(joints)), *learning_rows(task, arm)]:
        table.add_row(row.what, row.median, row.note)
    Console().print(table)


if __name__ == "__main__":
    main()
