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
from hydra import compose, initialize_config_dir
from rich.console import Console
from rich.table import Table

from koopdqn.app.commands.configuration import Configuration
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.generate import generate
from koopdqn.intent.fit import Fitted, agent_steps, fit
from koopdqn.intent.reward import IntentReward
from koopdqn.resources import asset_path, conf_dir
from koopdqn.rl.dqn import Learner
from koopdqn.rl.network import observe, size
from koopdqn.rl.replay_buffer import ReplayBuffer, Transitions
from koopdqn.robot.arm import Arm
from koopdqn.tasks.actions import COUNT
from koopdqn.tasks.workcell import open_workcell

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


def configuration() -> Configuration:
    """Return the default config, as the commands read it."""
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        return Configuration.load(compose("config", overrides=["command=train", "out=unused"]))


def kinematics_rows(arm: Arm, poses: np.ndarray, joints: np.ndarray) -> list[Row]:
    """Return the inverse kinematics' time beside dm_control's, on the same poses and seeds, in this process."""
    # After koopdqn has chosen the rendering backend.
    from dm_control import mjcf
    from dm_control.utils.inverse_kinematics import qpos_from_site_pose

    seeds = np.vstack([joints[:1], joints[:-1]])

    def ours() -> None:
        for pose, seed in zip(poses, seeds, strict=True):
            arm.inverse(pose, seed)

    def together() -> None:
        arm.inverse_batch(poses, seeds)

    physics = mjcf.Physics.from_xml_string(asset_path(arm.asset).read_text(encoding="utf-8"))

    def peer() -> None:
        for pose, seed in zip(poses, seeds, strict=True):
            physics.data.qpos[:] = seed
            qpos_from_site_pose(physics, arm.flange_site, pose[:3], pose[3:], inplace=True, tol=1e-9)

    mine, batched = median_seconds(ours) / len(poses), median_seconds(together) / len(poses)
    other = median_seconds(peer, 3) / len(poses)
    return [
        Row("inverse kinematics, closed form", f"{mine * 1e6:.1f} µs", "a call, along a path of 2 mm steps"),
        Row("the same, all at once", f"{batched * 1e6:.1f} µs", f"a pose, of {len(poses)}"),
        Row("the same by dm_control's qpos_from_site_pose", f"{other * 1e6:.1f} µs", f"{other / mine:.1f} times ours"),
    ]


def learning_rows(config: Configuration) -> list[Row]:
    """Return the times of the stages of learning."""
    task, agent = config.task, config.agent
    workcell = open_workcell(task, config.robot)

    def make() -> Demonstrations:
        return generate(task, workcell.reachability, config.demo, 0).demonstrations

    demonstrations = make()

    def fitting() -> Fitted:
        return fit(demonstrations, task, config.intent, config.trust, config.reward)

    fitted = fitting()
    trajectories = fitted.model.start_frame.each(agent_steps(demonstrations, task))
    reward = IntentReward(task, fitted.model, fitted.trust, config.reward)
    states = np.concatenate(trajectories)
    batch = states[np.random.default_rng(0).integers(len(states), size=agent.episodes_at_once)]
    none_made = np.zeros(len(batch), dtype=int)
    item = demonstrations.items[0]
    assert item.joints is not None
    rows = np.arange(agent.episodes_at_once) % len(item.poses)
    targets, angles = item.poses[rows], item.joints[rows]

    def move_alone() -> None:
        for pose, joints in zip(targets, angles, strict=True):
            workcell.reachability.move(pose, joints)

    def move_together() -> None:
        workcell.reachability.move_batch(targets, angles)

    rng = np.random.default_rng(0)
    torch.set_num_threads(1)
    learner = Learner(size(task), agent, rng)
    # Everything tried from each state, of which eight actions are wrong, as there are about.
    tried = np.repeat(states, COUNT, axis=0)
    replay = ReplayBuffer(len(tried), size(task))
    seen = observe(tried, task)
    flags = np.zeros(len(seen), dtype=bool)
    actions = np.tile(np.arange(COUNT), len(states))
    none = np.zeros(len(seen), dtype=np.int64)
    ones = np.ones(len(seen), np.float32)
    replay.add(
        Transitions(seen, actions, ones, seen, flags, flags, actions < COUNT - 2, tried, tried, none, none, none)
    )
    return [
        Row("five demonstrations", f"{median_seconds(make, 3):.2f} s", "on the arm, checked for collisions"),
        Row(
            "fitting, cross-validated",
            f"{median_seconds(fitting, 3):.2f} s",
            "",
        ),
        Row(
            "one step of the arm",
            f"{median_seconds(move_alone) / len(rows) * 1e6:.1f} µs",
            "inverse kinematics and collisions",
        ),
        Row(
            "the same in all episodes at once",
            f"{median_seconds(move_together) / len(rows) * 1e6:.1f} µs",
            f"a step, of {len(rows)}",
        ),
        Row(
            "evaluating all ten actions",
            f"{median_seconds(lambda: reward.evaluate_actions(batch, none_made)) / len(batch) * 1e6:.1f} µs",
            f"a state, {len(batch)} at once",
        ),
        Row(
            "one update of the network",
            f"{median_seconds(lambda: learner.update(replay.sample_states(rng, agent.batch))) * 1e3:.2f} ms",
            f"{agent.batch} states, one thread",
        ),
    ]


def environment_rows(count: int = 256, steps: int = 20) -> list[Row]:
    """Return how many steps a second Gymnasium's environment of many episodes makes, all that it does included."""
    import gymnasium

    import koopdqn.gym

    rng = np.random.default_rng(0)
    rows = []
    for what, random in (("the model's best actions, a tenth random", 0.1), ("random actions", 1.0)):
        env = gymnasium.make_vec("koopdqn/Shelf-v0", count)
        env.reset(seed=0)
        reward = koopdqn.gym.environment_parts("shelf").reward
        where, starts = env.reset()[1]["pose"], np.tile(reward.task.nominal_start, (count, 1))
        rates = []
        for _ in range(REPEATS * steps):
            best = reward.evaluate_actions(where, np.zeros(count, dtype=np.int64), starts).margin.argmax(axis=1)
            actions = np.where(rng.random(count) < random, rng.integers(COUNT, size=count), best)
            began = time.process_time()
            where = env.step(actions)[4]["pose"]
            rates.append(count / (time.process_time() - began))
        rows.append(
            Row(f"make_vec, {count} episodes: {what}", f"{statistics.median(rates):.0f}/s", "of processor time")
        )
    return rows


def startup_row() -> Row:
    """Return the time of `koopdqn --help` as a whole process."""
    command = [str(Path(sys.executable).with_name("koopdqn")), "--help"]
    seconds = median_seconds(lambda: subprocess.run(command, check=True, capture_output=True))
    return Row("koopdqn --help", f"{seconds:.2f} s", "a whole process")


def main() -> None:
    """Measure and print."""
    config = configuration()
    task, arm = config.task, config.robot
    start = task.nominal_start
    poses = task.demonstrator.roll_out(start, 1000)
    joints = [np.array(arm.solutions(start)[0])]
    for pose in poses[1:]:
        joints.append(np.array(arm.inverse(pose, joints[-1]).joints))
    table = Table("what", "median", "note", title="koopdqn on this machine")
    for row in [
        startup_row(),
        *kinematics_rows(arm, poses, np.array(joints)),
        *learning_rows(config),
        *environment_rows(),
    ]:
        table.add_row(row.what, row.median, row.note)
    Console().print(table)


if __name__ == "__main__":
    main()
