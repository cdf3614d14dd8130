"""Measuring against demonstrations that nothing was learned from: one episode from each one's start."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from koopdqn import pose
from koopdqn.evaluation.baselines import greedy, nearest_demonstration, straight_line
from koopdqn.evaluation.deviation import hausdorff_mm
from koopdqn.evaluation.metrics import measure
from koopdqn.evaluation.schema import Baselines, HoldoutReport, MethodReport
from koopdqn.intent.model import IntentModel
from koopdqn.intent.trust import TrustDomain
from koopdqn.pose import Array
from koopdqn.rollout import Controller, Episode, roll_out
from koopdqn.workcell import Workcell

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
    model: IntentModel,
    trust: TrustDomain,
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
        model: the fitted intent, for the greedy baseline.
        trust: the tube.
        trajectories: what was learned from, poses (N, 7) at the agent's step, for the baseline that replays one.
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

    def measured(name: str, begin: Callable[[], list[Episode]]) -> tuple[MethodReport, list[Episode]]:
        made = begin() if ready else []
        # An arm that cannot take the start has failed before its first step.
        home = np.array(workcell.arm.home)[None]
        episodes = [
            made[ready.index(index)]
            if index in ready
            else Episode(path[:1], home, entered[index].reason, entered[index].detail)
            for index, path in enumerate(held_out)
        ]
        hausdorff[name] = [hausdorff_mm(episode.poses, path) for episode, path in zip(episodes, held_out, strict=True)]
        return measure(episodes, held_out, task, trust, model.start_frame, workcell.reachability), episodes

    limit = step_limit
    report, episodes = measured("policy", lambda: roll_out(policy, task, workcell.reachability, starts, joints, limit))
    beside = None
    if baselines:
        beside = Baselines(
            straight_line=measured("straight_line", lambda: straight_line(workcell, starts, joints))[0],
            greedy=measured("greedy", lambda: greedy(workcell, model, starts, joints, limit))[0],
            nearest_demonstration=measured(
                "nearest_demonstration", lambda: nearest_demonstration(workcell, trajectories, starts, joints)
            )[0],
        )
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
