"""A policy measured on held-out starts and demonstrations: the content of ``eval.json``."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from koopdqn import pose
from koopdqn.evaluation.baselines import baseline_episodes
from koopdqn.evaluation.dynamics import play, summarise
from koopdqn.evaluation.metrics import hausdorff_mm, measure, reference_paths
from koopdqn.evaluation.schema import (
    Baselines,
    DynamicsReport,
    EvaluationReport,
    EvaluationSettings,
    HoldoutReport,
    MethodReport,
)
from koopdqn.intent.reward import IntentReward
from koopdqn.pose import Array
from koopdqn.rl.policy import tube_of
from koopdqn.safety.guard import Guard, GuardSettings
from koopdqn.safety.separation import separation, separation_report
from koopdqn.tasks.moved_goals import DrawnStarts, draw_starts
from koopdqn.tasks.rollout import SUCCESS, Controller, Episode, roll_out
from koopdqn.tasks.workcell import Workcell

# Sets the starts' random stream apart from those of demonstrations (1), training (2) and its checks (3),
# even if the seeds are equal.
_STREAM = 4


@dataclass(frozen=True)
class Evaluation:
    """A finished evaluation.

    Attributes:
        report: the content of ``eval.json``, as :class:`EvaluationReport` defines it; JSON values only.
        episodes: the policy's, from drawn starts.
        compared: the policy's episodes that have a reference: the same, or, where held-out demonstrations are the
            references, those from their starts.
        references: (T, 7) for each of them: the demonstrator's own path, or the held-out demonstration.
    """

    report: dict[str, Any]
    episodes: list[Episode]
    compared: list[Episode]
    references: list[Array]


def work_units(settings: EvaluationSettings) -> int:
    """Return how many units of work :func:`evaluate` tells ``advance`` of: paths rolled out or executed."""
    methods = 1 + (len(Baselines.model_fields) if settings.baselines else 0)
    return methods * settings.episodes + (settings.dynamics_episodes if settings.dynamics else 0)


def drawn_starts(workcell: Workcell, settings: EvaluationSettings) -> DrawnStarts:
    """Return the held-out starts, and the goals of a task whose goal moves.

    Raises:
        BadInputError: hardly any start of the region can be taken, or the goal given is none of the task's.
    """
    region, rng = (
        workcell.task.with_starts_scaled(settings.start_scale),
        np.random.default_rng([settings.seed, _STREAM]),
    )
    goal = None if settings.goal is None else workcell.task.goal_displacement(settings.goal)
    return draw_starts(workcell, region, rng, settings.episodes, goal)


def evaluate(
    workcell: Workcell,
    policy: Controller,
    reward: IntentReward,
    trajectories: list[Array],
    settings: EvaluationSettings,
    step_limit: int,
    advance: Callable[[int], None] = lambda units: None,
    held_out: list[Array] | None = None,
    guard: GuardSettings | None = None,
) -> Evaluation:
    """Measure a policy on held-out starts. The policy alone acts: no intent model, oracle, mask or look-ahead.

    Args:
        workcell: task, arm and scene.
        policy: chooses the actions (N,) from poses (N, 7).
        reward: with the fitted intent and its tube, for ``tube_fraction`` and the baselines.
        trajectories: demonstrated poses (N, 7) at the agent's step, for the baselines that replay them.
        settings: on which starts, and what is measured beside.
        step_limit: steps after which an episode fails.
        advance: told the units of work just done, of :func:`work_units`.
        held_out: for a task made from demonstrations, those kept for evaluation, poses (N, 7) at the agent's step;
            they are then the only references, and drawn starts count for success. None otherwise.
        guard: what the guard allows of the paths that are executed in dynamics; None executes them unguarded.

    Raises:
        BadInputError: hardly any start of the region can be taken, or an actuator is no position actuator.
    """
    task = workcell.task
    drawn = drawn_starts(workcell, settings)
    starts, joints, moved = drawn.starts, drawn.joints, drawn.moved
    references = reference_paths(task, starts, step_limit) if held_out is None else None
    episodes = roll_out(policy, task, workcell.reachability, starts, joints, step_limit, moved=moved)
    advance(len(episodes))
    baselines = {}
    if settings.baselines:
        for name, made in baseline_episodes(workcell, reward, trajectories, starts, joints, step_limit, moved):
            baselines[name] = _measured(workcell, reward, made, references)
            advance(len(made))
    holdout, compared = None, episodes if held_out is None else []
    if held_out:
        holdout, compared = _holdout(
            workcell,
            policy,
            reward,
            trajectories,
            held_out,
            step_limit,
            # A goal that is drawn anew at every start is none of the held-out demonstrations'.
            np.zeros(3) if settings.goal is None else moved[0],
            baselines=settings.baselines,
        )
    report = EvaluationReport(
        task=task.name,
        episodes=settings.episodes,
        seed=settings.seed,
        start_scale=settings.start_scale,
        redrawn_starts=drawn.redrawn,
        step_limit=step_limit,
        dynamics=_dynamics(workcell, reward, policy, episodes, settings, guard, advance) if settings.dynamics else None,
        baselines=Baselines(**baselines) if settings.baselines else None,
        holdout=holdout,
        # A corrected path is trusted along its correction, as the guard of its execution holds it too.
        **dict(_measured(workcell, replace(reward, trust=tube_of(policy, reward.trust)), episodes, references)),
    )
    return Evaluation(report.model_dump(mode="json"), episodes, compared, held_out or references or [])


def _measured(
    workcell: Workcell, reward: IntentReward, episodes: list[Episode], references: list[Array] | None
) -> MethodReport:
    frame = reward.model.start_frame
    return measure(episodes, references, workcell.task, reward.trust, frame, workcell.reachability)


def _dynamics(
    workcell: Workcell,
    reward: IntentReward,
    policy: Controller,
    episodes: list[Episode],
    settings: EvaluationSettings,
    guard: GuardSettings | None,
    advance: Callable[[int], None],
) -> DynamicsReport:
    chosen = [episode for episode in episodes if episode.outcome == SUCCESS][: settings.dynamics_episodes]
    tube = tube_of(policy, reward.trust)
    keeper = (
        None
        if guard is None
        else Guard(workcell, guard, tube, reward.model.start_frame, time_scale=settings.time_scale)
    )
    executions, near = [], []
    for episode in chosen:
        joints, durations = episode.joints, settings.time_scale * workcell.reachability.durations(episode.joints)
        if keeper and (refusal := keeper.review(episode.in_world, joints, episode.moved)):
            joints = joints[: refusal.step + 1]
            durations = keeper.durations(joints, settings.time_scale)
        advance(1)
        if len(joints) < 2:
            continue
        executions.append(play(workcell, joints, durations))
        if guard and guard.person:
            times = np.concatenate([[0.0], np.cumsum(durations)])
            found = separation(workcell.scene, joints, times, guard.person)
            near.append(separation_report(found, times.tolist()))
    advance(settings.dynamics_episodes - len(chosen))
    report = summarise(executions, settings.time_scale, workcell.arm.step_seconds)
    refused = keeper.report() if keeper else None
    return report.model_copy(
        update={"guard": refused, "separation": min(near, key=lambda each: each.margin_m, default=None)}
    )


def _holdout(
    workcell: Workcell,
    policy: Controller,
    reward: IntentReward,
    trajectories: list[Array],
    held_out: list[Array],
    step_limit: int,
    moved: Array,
    *,
    baselines: bool,
) -> tuple[HoldoutReport, list[Episode]]:
    """Return the section ``holdout`` of ``eval.json`` and the policy's episodes, one a held-out demonstration.

    The held-out demonstrations are moved with the goal, by ``moved`` (3,) [m].
    """
    task, away = workcell.task, np.concatenate([moved, np.zeros(4)])
    # An episode that began turned otherwise than what is held would have broken the rule already.
    begun = task.as_held(np.array([path[0] for path in held_out]))
    entered = [workcell.reachability.enter(start + away) for start in begun]
    ready = [index for index, motion in enumerate(entered) if motion.joints is not None]
    starts = begun[ready]
    joints = np.array([entered[index].joints for index in ready]).reshape(-1, len(workcell.arm.joint_names))
    hausdorff: dict[str, list[float | None]] = {}

    def measured(name: str, made: list[Episode]) -> tuple[MethodReport, list[Episode]]:
        # An arm that cannot take the start has failed before its first step.
        home = np.array(workcell.arm.home)[None]
        episodes = [
            made[ready.index(index)]
            if index in ready
            else Episode(begun[index : index + 1], home, entered[index].reason, entered[index].detail)
            for index in range(len(held_out))
        ]
        hausdorff[name] = [
            hausdorff_mm(episode.poses, path) if episode.steps else None
            for episode, path in zip(episodes, held_out, strict=True)
        ]
        return _measured(workcell, reward, episodes, held_out), episodes

    goals = np.tile(moved, (len(starts), 1))
    own = roll_out(policy, task, workcell.reachability, starts, joints, step_limit, moved=goals) if ready else []
    report, episodes = measured("policy", own)
    beside = None
    if baselines:
        # Where the arm can take no start there is nothing to make.
        each = baseline_episodes(workcell, reward, trajectories, starts, joints, step_limit, goals) if ready else ()
        made = dict(each)
        beside = Baselines(**{name: measured(name, made.get(name, []))[0] for name in Baselines.model_fields})
    holdout = HoldoutReport(
        demonstrations=len(held_out),
        outcomes=[episode.outcome for episode in episodes],
        hausdorff_mm=hausdorff,
        end_gap_mm=[float(pose.position_distance(path[-1], task.goal)) * 1e3 for path in held_out],
        policy=report,
        baselines=beside,
    )
    return holdout, episodes
