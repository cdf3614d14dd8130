"""Evaluating a policy on held-out starts, beside what comes without learning: the content of ``eval.json``."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from koopdqn.evaluation.baselines import without_learning
from koopdqn.evaluation.dynamics import execute, summarise
from koopdqn.evaluation.holdout import measure_holdout
from koopdqn.evaluation.metrics import measure
from koopdqn.evaluation.references import reference_paths
from koopdqn.evaluation.schema import Baselines, DynamicsReport, EvaluationReport, MethodReport
from koopdqn.evaluation.settings import EvaluationSettings
from koopdqn.intent.reward import IntentReward
from koopdqn.pose import Array
from koopdqn.tasks.rollout import SUCCESS, Controller, Episode, roll_out
from koopdqn.tasks.workcell import Workcell

if TYPE_CHECKING:
    from rich.table import Table

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


def drawn_starts(workcell: Workcell, settings: EvaluationSettings) -> tuple[Array, Array, int]:
    """Return the held-out starts (N, 7), joints (N, 6) [rad] there, and how many draws were drawn again.

    Raises:
        BadInputError: hardly any start of the region can be taken.
    """
    region = workcell.task.with_starts_scaled(settings.start_scale)
    return workcell.reachability.draw_starts(region, np.random.default_rng([settings.seed, _STREAM]), settings.episodes)


def evaluate(
    workcell: Workcell,
    policy: Controller,
    reward: IntentReward,
    trajectories: list[Array],
    settings: EvaluationSettings,
    step_limit: int,
    advance: Callable[[int], None] = lambda units: None,
    held_out: list[Array] | None = None,
) -> Evaluation:
    """Measure a policy on held-out starts. The policy alone acts: no intent model, oracle, mask or look-ahead.

    Args:
        workcell: task, arm and scene.
        policy: chooses the actions (N,) from poses (N, 7).
        reward: with the fitted intent and its tube, for ``tube_fraction`` and what comes without learning.
        trajectories: demonstrated poses (N, 7) at the agent's step, for the baselines that replay them.
        settings: on which starts, and what is measured beside.
        step_limit: steps after which an episode fails.
        advance: told the units of work just done, of :func:`work_units`.
        held_out: for a task made from demonstrations, those kept for evaluation, poses (N, 7) at the agent's step;
            they are then the only references, and drawn starts count for success. None otherwise.

    Raises:
        BadInputError: hardly any start of the region can be taken, or an actuator is no position actuator.
    """
    task = workcell.task
    starts, joints, redrawn = drawn_starts(workcell, settings)
    references = reference_paths(task, starts, step_limit) if held_out is None else None
    episodes = roll_out(policy, task, workcell.reachability, starts, joints, step_limit)
    advance(len(episodes))

    def measured(baseline: list[Episode]) -> MethodReport:
        advance(len(baseline))
        return measure(baseline, references, task, reward.trust, reward.model.start_frame, workcell.reachability)

    baselines = None
    if settings.baselines:
        found = without_learning(workcell, reward, trajectories, starts, joints, step_limit)
        baselines = Baselines(**{name: measured(each) for name, each in found})
    dynamics = _dynamics(workcell, episodes, settings, advance) if settings.dynamics else None
    policy_report = measure(episodes, references, task, reward.trust, reward.model.start_frame, workcell.reachability)
    holdout = None
    if held_out:
        holdout = measure_holdout(
            workcell, policy, reward, trajectories, held_out, step_limit, baselines=settings.baselines
        )
    report = EvaluationReport(
        task=task.name,
        episodes=settings.episodes,
        seed=settings.seed,
        start_scale=settings.start_scale,
        redrawn_starts=redrawn,
        step_limit=step_limit,
        dynamics=dynamics,
        baselines=baselines,
        holdout=holdout.report if holdout else None,
        **dict(policy_report),
    )
    compared = episodes if held_out is None else holdout.episodes if holdout else []
    return Evaluation(report.model_dump(mode="json"), episodes, compared, held_out or references or [])


def _dynamics(
    workcell: Workcell, episodes: list[Episode], settings: EvaluationSettings, advance: Callable[[int], None]
) -> DynamicsReport:
    chosen = [episode for episode in episodes if episode.outcome == SUCCESS][: settings.dynamics_episodes]
    executions = []
    for episode in chosen:
        executions.append(execute(workcell, episode.joints, settings.time_scale))
        advance(1)
    advance(settings.dynamics_episodes - len(chosen))
    return summarise(executions, settings.time_scale, workcell.arm.step_seconds)


def table(report: dict[str, Any]) -> "Table":
    """Return the content of ``eval.json`` as a table of one row per method, the policy first."""
    from rich import box
    from rich.table import Table

    found = Table(
        title=f"{report['task']}: {report['episodes']} held-out starts, seed {report['seed']}",
        caption="deviation: mean and 95th percentile of the largest, points matched by arc length",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    found.add_column("method", no_wrap=True)
    for heading in ("success", "deviation", "sideways"):
        found.add_column(heading, justify="right", no_wrap=True)
    found.add_column("failures")
    for name, method in {"policy": report, **(report["baselines"] or {})}.items():
        found.add_row(name.replace("_", " "), *_cells(method))
    return found


def holdout_table(report: dict[str, Any]) -> "Table":
    """Return the section ``holdout`` of ``eval.json`` as a table of one row per method, the policy first."""
    from rich import box
    from rich.table import Table

    holdout = report["holdout"]
    found = Table(
        title=f"{report['task']}: from the starts of {holdout['demonstrations']} held-out demonstrations",
        caption="Hausdorff in mm: the farthest from the held-out demonstration, median and largest",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    found.add_column("method", no_wrap=True)
    for heading in ("success", "Hausdorff", "deviation", "sideways"):
        found.add_column(heading, justify="right", no_wrap=True)
    found.add_column("failures")
    for name, method in {"policy": holdout["policy"], **(holdout["baselines"] or {})}.items():
        success, *rest = _cells(method)
        apart = np.array(holdout["hausdorff_mm"][name])
        found.add_row(name.replace("_", " "), success, f"{np.median(apart):.1f} / {apart.max():.1f}", *rest)
    return found


def _cells(method: dict[str, Any]) -> list[str]:
    deviation, (low, high) = method["path_deviation_mm"], method["success_interval_95"]
    causes = sorted(((count, cause) for cause, count in method["failures"].items() if count), reverse=True)
    return [
        f"{method['success_rate']:.0%} ({100 * low:.0f}–{100 * high:.0f})",
        f"{_number(deviation['mean'], 1)} / {_number(deviation['p95_of_max'], 0)} mm",
        f"{_number(method['lateral_deviation_mm']['mean'], 1)} mm",
        ", ".join(f"{count} {cause.replace('_', ' ')}" for count, cause in causes) or "none",
    ]


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"
