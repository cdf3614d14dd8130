"""``koopdqn eval``: measure a trained run on held-out starts."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import RenderableType

from koopdqn import console
from koopdqn.app.commands import pipeline
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.commands.trained import differs_from_trained, read_trained
from koopdqn.app.hydra.application import CommandResult
from koopdqn.artifact import reading
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.errors import BadInputError
from koopdqn.evaluation.evaluate import Evaluation, evaluate, work_units
from koopdqn.evaluation.schema import EvaluationFile
from koopdqn.files import sha256_of, write_json
from koopdqn.run_folder import EVALUATION, FIT_PICTURE, POLICY, TRAINING_PICTURE
from koopdqn.tasks.rollout import SUCCESS, Episode
from koopdqn.tasks.workcell import Workcell

if TYPE_CHECKING:
    from rich.table import Table


def run(config: Configuration, folder: Path) -> CommandResult:
    """Measure the run of ``run=``; write ``eval.json`` and ``eval.png``."""
    from koopdqn.plots.evaluation import plot_evaluation
    from koopdqn.plots.style import LEARNED

    source = config.run
    film = folder / "eval.mp4"
    if config.eval.video:
        from koopdqn.view.film import check_film

        check_film(film, "eval.video")
    trained = read_trained(config, source)
    demonstrations, workcell, about = trained.demonstrations, trained.workcell, trained.about
    made_from = {"demonstrations": demonstrations.digest(), "intent": trained.intent.digest()}
    for name, sha in made_from.items():
        with reading(f"policy {source / POLICY}"):
            made_with = about["made_from"][name]
        if made_with != sha:
            raise BadInputError(f"run {source}: the {name} must be those the policy was made from, found others")
    with console.stage("Evaluating", work_units(config.eval)) as stage:
        evaluation = evaluate(
            workcell,
            trained.policy,
            trained.reward,
            trained.trajectories,
            config.eval,
            trained.step_limit,
            stage.advance,
            pipeline.held_out_of(config),
            config.guard,
        )
    another_arm = differs_from_trained(config.robot, about["robot"])
    as_trained = (
        not (trained.obstacles_added or another_arm) and config.eval.goal is None and config.eval.start_scale == 1.0
    )
    content = {**evaluation.report, "run": str(source), "as_trained": as_trained, "policy": sha256_of(source / POLICY)}
    report = EvaluationFile.model_validate(content).model_dump(mode="json")
    write_json(folder / EVALUATION, report)
    drawn = next((e for e in evaluation.episodes if e.outcome == SUCCESS), evaluation.episodes[0])
    paths = [episode.positions for episode in evaluation.episodes[:20]]
    image = pipeline.picture(workcell.scene, drawn.joints, paths, [LEARNED] * len(paths))
    plot_evaluation(folder / "eval.png", evaluation, demonstrations, config.task, image)
    lines: list[RenderableType] = [
        f"measured run    {console.shown_path(source)}",
        *(f"{how:<14}  {what}" for how, what in trained.beside),
        table(report),
        *off(report, "the demonstrator's own path", continuous=config.agent.continuous),
        *_guarded(report["dynamics"]),
        *_held_out(report, continuous=config.agent.continuous),
        f"report          {console.shown_path(folder / EVALUATION)}",
        f"learned path    {console.shown_path(folder / 'eval.png')}",
    ]
    if config.eval.video:
        _film(film, workcell, demonstrations, drawn, evaluation)
        lines.append(f"film            {console.shown_path(film)}")
    for name, file in (("training curve", TRAINING_PICTURE), ("fit errors", FIT_PICTURE)):
        if (source / file).exists():
            lines.append(f"{name:<14}  {console.shown_path(source / file)}")
    return CommandResult(report, lines, objective=report["success_rate"])


def _guarded(dynamics: dict[str, Any] | None) -> list[RenderableType]:
    """Return lines on what the guard stopped and on the person near the arm, if there is anything to say."""
    if dynamics is None:
        return []
    lines: list[RenderableType] = []
    if dynamics["guard"] and dynamics["guard"]["stopped"]:
        lines.append(f"guard           {dynamics['guard']['stopped']} stopped; {dynamics['guard']['first']}")
    if near := dynamics["separation"]:
        lines.append(near_person(near))
    return lines


def near_person(near: dict[str, Any]) -> str:
    """Return one line on the distance to the person where it lacks most."""
    return (
        f"person          {near['distance_m']:.3f} m off where your parameters ask for {near['required_m']:.3f} m,"
        f" kept at {near['kept_fraction']:.0%} of the path"
    )


def _film(
    path: Path, workcell: Workcell, demonstrations: Demonstrations, drawn: Episode, evaluation: Evaluation
) -> None:
    """Write a film of an episode beside the demonstration that begins nearest to it."""
    from koopdqn.view.motions import demonstrated_motions, learned_motion

    references = dict(zip(map(id, evaluation.compared), evaluation.references, strict=True))
    learned = learned_motion("a held-out start", drawn, workcell.task, references.get(id(drawn)))
    clear = workcell.without_obstacles().reachability
    shown = demonstrated_motions(demonstrations.items, clear, workcell.task, len(demonstrations))
    pipeline.film(path, workcell.scene, replace(learned, poses=drawn.in_world), shown)


def table(report: dict[str, Any]) -> "Table":
    """Return the content of ``eval.json`` as a table of one row per method, the policy first."""
    methods = {"policy": report, **(report["baselines"] or {})}
    headings, rows = ["method", "success", "failures"], {name: _cells(method) for name, method in methods.items()}
    words = {"title": f"{report['task']}: {report['episodes']} held-out starts, seed {report['seed']}"}
    if any(method["path_deviation_mm"]["mean"] is not None for method in methods.values()):
        headings[2:2] = ["deviation", "sideways"]
        words["caption"] = "deviation: mean and 95th percentile of the largest, points matched by arc length"
    else:
        # There is no demonstrator's own path from these starts.
        rows = {name: [success, failures] for name, (success, *_, failures) in rows.items()}
    return _methods(headings, rows, **words)


def off(method: dict[str, Any], whose: str, *, continuous: bool) -> list[RenderableType]:
    """Return lines on how far a policy's turn is off, where one is learned, and its paths' length, if that is far off.

    Args:
        method: the policy's keys.
        whose: of whom its references are.
        continuous: whether its actions are twists.
    """
    lines: list[RenderableType] = []
    turn, ratio = method["rotation_deviation_deg"], method["path_length_ratio"]
    if method["turn"] is not None and turn["mean"] is not None:
        lines.append(f"turn            {turn['mean']:.1f}° off that of {whose} on average, {turn['max']:.0f}° at most")
    # The stairs of ten directions alone lengthen a path by up to √3.
    if ratio is not None and not 0.8 <= ratio <= (1.25 if continuous else 3**0.5):
        lines.append(f"path length     {ratio:.2f} times that of {whose} on average")
    return lines


def _held_out(report: dict[str, Any], *, continuous: bool) -> list[RenderableType]:
    """Return what is told of held-out demonstrations, if there are any."""
    if not report["holdout"]:
        return []
    told = off(report["holdout"]["policy"], "the demonstration held out", continuous=continuous)
    return [holdout_table(report), *told]


def holdout_table(report: dict[str, Any]) -> "Table":
    """Return the section ``holdout`` of ``eval.json`` as a table of one row per method, the policy first."""
    holdout, rows = report["holdout"], {}
    count = holdout["demonstrations"]
    begun = (
        "the start of the held-out demonstration" if count == 1 else f"the starts of {count} held-out demonstrations"
    )
    for name, method in {"policy": holdout["policy"], **(holdout["baselines"] or {})}.items():
        success, deviation, _, failures = _cells(method)
        apart = [value for value in holdout["hausdorff_mm"][name] if value is not None]
        far = f"{np.median(apart):.1f} / {max(apart):.1f}" if apart else "–"
        rows[name] = [success, far, deviation.removesuffix(" mm"), failures]
    return _methods(
        ("method", "success", "Hausdorff", "deviation", "failures"),
        rows,
        title=f"{report['task']}: from {begun}",
        caption="in mm; Hausdorff: the farthest from the held-out demonstration, median and largest",
    )


def _methods(headings: Sequence[str], rows: dict[str, list[str]], **words: str) -> "Table":
    from rich import box

    cells = [[name.replace("_", " "), *row] for name, row in rows.items()]
    look = {"box": box.SIMPLE_HEAD, "padding": (0, 1, 0, 0), **words}
    return console.table(headings, cells, ("method", "failures"), whole="cells", **look)


def _cells(method: dict[str, Any]) -> list[str]:
    deviation, (low, high) = method["path_deviation_mm"], method["success_interval_95"]
    causes = sorted(((count, cause) for cause, count in method["failures"].items() if count), reverse=True)
    return [
        f"{console.percent(method['success_rate'])} ({100 * low:.0f}–{100 * high:.0f})",
        f"{_number(deviation['mean'], 1)} / {_number(deviation['p95_of_max'], 0)} mm",
        f"{_number(method['lateral_deviation_mm']['mean'], 1)} mm",
        ", ".join(f"{count} {cause.replace('_', ' ')}" for count, cause in causes) or "none",
    ]


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"
