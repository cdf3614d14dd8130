"""``koopdqn eval``: measure a trained run on held-out starts."""

from pathlib import Path

from rich.console import RenderableType

from koopdqn import console
from koopdqn.app.commands import stages
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.commands.train import POLICY, REPORT
from koopdqn.app.result import CommandResult
from koopdqn.artifact import reading
from koopdqn.errors import BadInputError
from koopdqn.files import read_json, write_json
from koopdqn.intent.fit import agent_steps
from koopdqn.intent.reward import IntentReward
from koopdqn.intent.storage import read_intent
from koopdqn.pose import POSITION
from koopdqn.settings import shown
from koopdqn.tasks.rollout import SUCCESS

_LONGEST = 1_000_000
"""The most steps that an episode may be given."""


def run(config: Configuration, folder: Path) -> CommandResult:
    """Measure the run of ``run=``; write ``eval.json`` and ``eval.png``."""
    from koopdqn.evaluation.evaluate import evaluate, holdout_table, table, work_units
    from koopdqn.evaluation.schema import EvaluationFile
    from koopdqn.plots.evaluation import plot_evaluation
    from koopdqn.plots.style import LEARNED
    from koopdqn.rl.policy import read_policy

    source = config.inputs.run
    if source is None:
        raise BadInputError("run: must name the folder of a trained run, found none: first `koopdqn train`")
    policy, about = read_policy(source / POLICY, config.task)
    demonstrations = stages.demonstrations_of(config, source)
    intent = read_intent(source / stages.INTENT, config.task)
    made_from = {"demonstrations": demonstrations.digest(), "intent": intent.digest()}
    for name, sha in made_from.items():
        with reading(f"policy {source / POLICY}"):
            made_with = about["made_from"][name]
        if made_with != sha:
            raise BadInputError(f"run {source}: the {name} must be those the policy was made from, found others")
    step_limit = _step_limit(source / REPORT)
    workcell = stages.open_scene(config)
    with console.stage("Evaluating", work_units(config.eval)) as stage:
        evaluation = evaluate(
            workcell,
            policy,
            IntentReward(config.task, intent.model, intent.trust, config.reward),
            agent_steps(demonstrations, config.task),
            config.eval,
            step_limit,
            stage.advance,
            stages.held_out_of(config),
        )
    content = {**evaluation.report, "run": str(source)}
    report = EvaluationFile.model_validate(content).model_dump(mode="json")
    write_json(folder / "eval.json", report)
    shown = next((e for e in evaluation.episodes if e.outcome == SUCCESS), evaluation.episodes[0])
    paths = [episode.poses[:, POSITION] for episode in evaluation.episodes[:20]]
    image = stages.picture(workcell.scene, shown.joints, paths, [LEARNED] * len(paths))
    plot_evaluation(
        folder / "eval.png",
        report,
        evaluation.episodes,
        evaluation.references,
        demonstrations,
        config.task,
        image,
        evaluation.compared,
    )
    lines: list[RenderableType] = [
        f"measured run    {console.shown_path(source)}",
        table(report),
        *([holdout_table(report)] if report["holdout"] else []),
        f"report          {console.shown_path(folder / 'eval.json')}",
        f"learned path    {console.shown_path(folder / 'eval.png')}",
    ]
    if (source / "train.png").exists():
        lines.append(f"training curve  {console.shown_path(source / 'train.png')}")
    if (source / "fit.png").exists():
        lines.append(f"fit errors      {console.shown_path(source / 'fit.png')}")
    return CommandResult(report, lines, objective=report["success_rate"])


def _step_limit(path: Path) -> int:
    report = read_json(path, "the training report")
    limit = report.get("step_limit") if isinstance(report, dict) else None
    if not isinstance(limit, int) or isinstance(limit, bool) or not 1 <= limit <= _LONGEST:
        raise BadInputError(
            f"{path}: step_limit must be a whole number above 0, at most {_LONGEST}, found {shown(limit)}"
        )
    return limit
