"""``koopdqn train``: learn the path."""

from contextlib import closing, nullcontext
from pathlib import Path
from time import monotonic
from typing import Any

from koopdqn import console
from koopdqn.app.commands import pipeline
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.hydra.application import CommandResult, how_to_go_on, in_sweep, record_continued
from koopdqn.artifact import described, reading
from koopdqn.errors import BadInputError
from koopdqn.files import read_json, write_json
from koopdqn.intent.fit import agent_steps
from koopdqn.intent.reward import BY_MODEL, IntentReward
from koopdqn.oracles.base import Oracle
from koopdqn.oracles.replay import JournalledOracle
from koopdqn.pose import Array
from koopdqn.rl.algorithm1 import Trainer
from koopdqn.rl.checkpoint import EventLog, check_begun, questions_asked, read_checkpoint, save_checkpoint
from koopdqn.rl.checks import Check
from koopdqn.rl.human_reward import answering
from koopdqn.rl.network import size
from koopdqn.rl.policy import write_policy
from koopdqn.rl.schema import TrainReport
from koopdqn.rl.settings import check_device, check_memory
from koopdqn.run_folder import BEGUN, CHECKPOINT, DEMONSTRATIONS, JOURNAL, POLICY, TRAINING, TRAINING_PICTURE
from koopdqn.settings import shown
from koopdqn.tasks.workcell import Workcell
from koopdqn.view.dashboard import Dashboard, fits

# The parts of a config that decide what a training makes before its first checkpoint.
_MADE_WITH = ("seed", "task", "robot", "reward")


def run(config: Configuration, folder: Path) -> CommandResult:
    """Learn from given or new demonstrations, or go on with the run that the folder holds."""
    try:
        return _run(config, folder)
    except BaseException as error:
        error.add_note(how_to_go_on("train", folder))
        raise


def _run(config: Configuration, folder: Path) -> CommandResult:
    began = monotonic()
    config.oracle.check()
    _check_threads(config)
    pipeline.check_intent_file(config)
    check_memory(config.agent, size(config.task))
    check_device(config.agent)
    workcell = pipeline.open_scene(config)
    _begin(config, folder)
    demonstrations = pipeline.demonstrations_for(config, workcell, folder)
    intent = pipeline.intent_for(config, demonstrations, folder)
    made_from = {"demonstrations": demonstrations.digest(), "intent": intent.digest()}
    # Earlier versions wrote down the config's own intent and trust, whatever intent=FILE held.
    earlier = {**config.shaped_by(), "made_from": made_from}
    config = pipeline.as_fitted(config, intent, folder)
    shaped_by = {**config.shaped_by(), "made_from": made_from}
    checkpoint = read_checkpoint(folder, shaped_by, earlier, config.robot)
    answered = questions_asked(checkpoint)
    before = 0.0 if checkpoint is None else float(checkpoint.about["seconds"])
    shown_paths = agent_steps(demonstrations, config.task)
    reward = pipeline.reward_of(config, workcell, intent, shown_paths)
    opened = answering(config.oracle.open(workcell, config.inputs.seed, folder), config.oracle, reward.model)
    oracle = JournalledOracle(opened, folder / JOURNAL, answered)
    trainer = trainer_of(config, workcell, reward, shown_paths, oracle)
    if checkpoint is not None:
        with reading(f"checkpoint {folder / CHECKPOINT}"):
            trainer.restore(checkpoint.arrays, checkpoint.about["state"])
        console.note(f"going on after {trainer.env_steps} actions and {trainer.questions} questions")
    done = 0 if checkpoint is None else trainer.env_steps
    dashboard = None
    if not config.oracle.shows_progress and not in_sweep() and fits(console.err()):
        poses = [item.poses for item in demonstrations.items]
        dashboard = Dashboard(trainer, poses, config.oracle.budget, console.err(), monotonic() - began + before)
    bar = dashboard is None and not config.oracle.shows_progress
    _learn(trainer, oracle, folder, shaped_by, began - before, dashboard, bar=bar)
    seconds = before + monotonic() - began
    if done == trainer.env_steps and (folder / TRAINING).is_file():
        console.note("nothing was left to do: the run had ended; train.stop=limit or higher limits let it go on")
        told = _held_in(folder / TRAINING, "the training report").get("seconds")
        seconds = float(told) if isinstance(told, int | float) else before
    made = trainer.best, config.agent.network, intent.model.start_frame, shaped_by
    write_policy(folder / POLICY, *made, continuous=config.agent.continuous)
    report = train_report(config, trainer, seconds, made_from)
    write_json(folder / TRAINING, report)
    # Here and not before: matplotlib takes a while to load, and learning need not wait for it.
    from koopdqn.plots.train import plot_training

    plot_training(folder / TRAINING_PICTURE, trainer.history, report)
    return CommandResult(
        report,
        _lines(report, folder, trainer),
        objective=report["best_success_rate"],
        exit_status=0 if trainer.learned else 1,
    )


def trainer_of(
    config: Configuration, workcell: Workcell, reward: IntentReward, shown: list[Array], oracle: Oracle
) -> Trainer:
    """Return what learns with a reward function from the poses (N, 7) of demonstrations; ``oracle`` answers it."""
    return Trainer(
        workcell,
        reward,
        reward.model.placed(shown),
        oracle,
        config.agent,
        config.train,
        config.inputs.seed,
        config.feedback,
        config.oracle,
    )


def _check_threads(config: Configuration) -> None:
    """Raise if a journal that is given again is of a run with another number of threads, as its report says."""
    journal = getattr(config.oracle, "journal", None)
    report = None if journal is None else Path(journal).parent / TRAINING
    if report is None or not report.is_file():
        return
    recorded = _held_in(report, "the training report").get("threads")
    if recorded not in (None, config.train.threads):
        raise BadInputError(
            f"train.threads: must be that of the run whose journal is given again ({shown(recorded)}, {report}), found"
            f" {config.train.threads}: sums in another order lead to other questions"
        )


def _begin(config: Configuration, folder: Path) -> None:
    """Write down with what a run begins; raise if something was made in the folder with another config.

    A checkpoint says it too, but demonstrations, intent and answers may stand in the folder before the first one.
    """
    path = folder / BEGUN
    made_with = {name: each for name, each in config.shaped_by().items() if name in _MADE_WITH}
    if not config.inputs.demos and config.derived is None:
        made_with["demo"] = described(config.demo)
    if path.exists():
        held = _held_in(path, "what the run was begun with")
        recorded = held.get("threads")
        if isinstance(recorded, bool) or recorded != config.train.threads:
            raise BadInputError(
                f"train.threads: must be {shown(recorded)}, with which the run in {folder} was begun, found"
                f" {config.train.threads}: sums in another order end in other bits"
            )
        if (folder / DEMONSTRATIONS).exists():
            # Earlier versions wrote down the threads alone.
            if "made_with" in held:
                check_begun(folder, held["made_with"], made_with, config.robot)
            return
    write_json(path, {"threads": config.train.threads, "made_with": made_with})


def _held_in(path: Path, what: str) -> dict[str, Any]:
    content = read_json(path, what)
    return content if isinstance(content, dict) else {}


def _learn(
    trainer: Trainer,
    oracle: JournalledOracle,
    folder: Path,
    shaped_by: dict[str, Any],
    began: float,
    dashboard: Dashboard | None,
    *,
    bar: bool,
) -> None:
    shown = 0
    # Closed first, so that what is said at the end finds the terminal as it was.
    with (
        console.stage("Learning", bar=bar) as stage,
        closing(EventLog(folder, trainer)) as events,
        dashboard or nullcontext(),
        closing(oracle),
    ):

        def on_check(check: Check) -> None:
            save_checkpoint(folder, trainer, shaped_by, monotonic() - began)
            events.check(check)
            stage.advance(0, _progress(trainer, check))

        def record_once_taken() -> None:
            # What is given now may be refused until the last answer of before fits the run.
            if oracle.caught_up:
                record_continued()

        def on_round() -> None:
            nonlocal shown
            record_once_taken()
            last = trainer.history.checks[-1] if trainer.history.checks else None
            oracle.learning(_progress(trainer, last))
            if dashboard is not None:
                dashboard.round()
            if trainer.rounds % 10 == 0:
                stage.advance(trainer.rounds - shown, _progress(trainer, last))
                shown = trainer.rounds

        try:
            trainer.run(on_check, on_round)
        except BaseException:
            record_once_taken()
            raise
        record_continued()


def _progress(trainer: Trainer, check: Check | None) -> str:
    success = "no check yet" if check is None else f"success {console.percent(check.success_rate)} of held-out starts"
    asked = console.counted(trainer.questions, "question")
    return f"{trainer.learner.updates} updates, {trainer.env_steps} actions, {asked}, {success}"


def train_report(config: Configuration, trainer: Trainer, seconds: float, made_from: dict[str, str]) -> dict[str, Any]:
    """Return the content of ``train.json``."""
    history = trainer.history
    asked_or_trusted = int(history.labelled[1:].sum())
    content = {
        "task": config.task.name,
        "seed": config.inputs.seed,
        "agent": config.agent.name,
        "intent": config.intent.name,
        "oracle": config.oracle.name,
        "learned": trainer.learned,
        "learned_at_env_steps": trainer.progress.learned_at if trainer.learned else None,
        "seconds": seconds,
        "episodes": len(history.rewards),
        "env_steps": trainer.env_steps,
        "updates": trainer.learner.updates,
        "oracle_queries": trainer.questions,
        "budget_spent": trainer.feedback.spent,
        "answered_instead": trainer.feedback.substituted,
        "contradictions": trainer.feedback.answers.contradictions,
        "rewards_recomputed": trainer.feedback.recomputed,
        "trusted_fraction": float(history.labelled[list(BY_MODEL)].sum() / asked_or_trusted)
        if asked_or_trusted
        else None,
        "reward_agreement": history.agreement(),
        "rewards_given": history.counts(),
        "reward_per_episode": history.rewards,
        "steps_per_episode": history.lengths,
        "exploring_episode": history.exploring,
        "best_success_rate": max(trainer.progress.best_success, 0.0),
        "best_update": trainer.progress.best_update,
        "step_limit": trainer.step_limit,
        "checks": [vars(check) for check in history.checks],
        "threads": config.train.threads,
        "device": check_device(config.agent),
        "made_from": made_from,
    }
    return TrainReport.model_validate(content).model_dump(mode="json")


def _lines(report: dict[str, Any], folder: Path, trainer: Trainer) -> list[str]:
    agreement = report["reward_agreement"]
    shown = ", ".join(
        f"{name} {'none given' if share is None else format(share, '.1%')}" for name, share in agreement.items()
    )
    verdict = "learned" if report["learned"] else "NOT learned within the limits"
    return [
        f"{verdict}: {report['seconds']:.1f} s, {report['updates']} updates, {report['env_steps']} actions tried,"
        f" {console.counted(report['oracle_queries'], 'question')} asked",
        *_ended_early(trainer, folder),
        f"rewards that the demonstrator agrees with: {shown}",
        f"policy          {console.shown_path(folder / POLICY)}",
        f"report          {console.shown_path(folder / TRAINING)}",
        f"training curve  {console.shown_path(folder / TRAINING_PICTURE)}",
    ]


def _ended_early(trainer: Trainer, folder: Path) -> list[str]:
    """Return a remark if no more questions may be asked, or training went less far than ``train.extend`` asks."""
    settings = trainer.settings
    if trainer.feedback.stopped and not trainer.learned:
        return [f"stopped by oracle.budget={trainer.questions}: {how_to_go_on('train', folder)} with a larger one"]
    if settings.stop == "learned" or settings.extend is None or not trainer.learned:
        return []
    reached = trainer.env_steps / trainer.progress.learned_at
    if reached >= settings.extend or trainer.feedback.stopped:
        return []
    name = "max_steps" if trainer.env_steps >= settings.max_steps else "max_episodes"
    return [
        f"went on to {reached:.1f} times the actions it took to learn, less than train.extend={settings.extend:g}:"
        f" train.{name}={getattr(settings, name)} came first"
    ]
