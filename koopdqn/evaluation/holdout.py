"""Measuring against demonstrations that nothing was learned from: one episode from each one's start."""

from dataclasses import dataclass

import numpy as np

from koopdqn import pose
from koopdqn.evaluation.baselines import without_learning
from koopdqn.evaluation.deviation import hausdorff_mm
from koopdqn.evaluation.metrics import measure
from koopdqn.evaluation.schema import Baselines, HoldoutReport, MethodReport
from koopdqn.intent.reward import IntentReward
from koopdqn.pose import Array
from koopdqn.tasks.rollout import Controller, Episode, roll_out
from koopdqn.tasks.workcell import Workcell

_MILLIMETRES = 1e3


@dataclass(frozen=True)
class Holdout:
    """What became of the held-out starts.

    Attributes:
        report: the section of ``eval.json``.
        episodes: the policy's, one a held-out demonstration.
    """

    report: HoldoutReport
    episodes: list[Episode]


def measure_holdout(
    workcell: Workcell,
    policy: Controller,
    reward: IntentReward,
    trajectories: list[Array],
    held_out: list[Array],
    step_limit: int,
    *,
    baselines: bool,
) -> Holdout:
    """Measure a policy from the start of each held-out demonstration, with that demonstration as the reference.

    Args:
        workcell: task, arm and scene.
        policy: chooses the actions (N,) from poses (N, 7).
        reward: with the fitted intent and its tube.
        trajectories: what was learned from, poses (N, 7) at the agent's step, for the baselines that replay it.
        held_out: poses (N, 7) at the agent's step of each held-out demonstration, at least one.
        step_limit: steps after which an episode fails.
        baselines: whether to measure what comes without learning too.
    """
    task = workcell.task
    entered = [workcell.reachability.enter(path[0]) for path in held_out]
    ready = [index for index, motion in enumerate(entered) if motion.joints is not None]
    starts = np.array([held_out[index][0] for index in ready]).reshape(-1, 7)
    joints = np.array([entered[index].joints for index in ready]).reshape(-1, 6)
    hausdorff: dict[str, list[float]] = {}

    def measured(name: str, made: list[Episode]) -> tuple[MethodReport, list[Episode]]:
        # An arm that cannot take the start has failed before its first step.
        home = np.array(workcell.arm.home)[None]
        episodes = [
            made[ready.index(index)]
            if index in ready
            else Episode(path[:1], home, entered[index].reason, entered[index].detail)
            for index, path in enumerate(held_out)
        ]
        hausdorff[name] = [hausdorff_mm(episode.poses, path) for episode, path in zip(episodes, held_out, strict=True)]
        return measure(
            episodes, held_out, task, reward.trust, reward.model.start_frame, workcell.reachability
        ), episodes

    own = roll_out(policy, task, workcell.reachability, starts, joints, step_limit) if ready else []
    report, episodes = measured("policy", own)
    beside = None
    if baselines:
        # Where the arm can take no start there is nothing to make.
        made = dict(without_learning(workcell, reward, trajectories, starts, joints, step_limit)) if ready else {}
        beside = Baselines(**{name: measured(name, made.get(name, []))[0] for name in Baselines.model_fields})
    gaps = [float(pose.position_distance(path[-1], task.goal)) * _MILLIMETRES for path in held_out]
    return Holdout(
        HoldoutReport(
            demonstrations=len(held_out),
            outcomes=[episode.outcome for episode in episodes],
            hausdorff_mm=hausdorff,
            end_gap_mm=gaps,
            policy=report,
            baselines=beside,
        ),
        episodes,
    )
