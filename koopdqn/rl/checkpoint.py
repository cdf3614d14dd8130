"""What a training leaves in its folder as it goes: its state in one file, written atomically, and events."""

import json
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from koopdqn.artifact import Artifact, described, read_artifact, reading, write_artifact
from koopdqn.errors import BadInputError
from koopdqn.files import canonical_json
from koopdqn.intent.model import IntentSettings
from koopdqn.rl.algorithm1 import Trainer
from koopdqn.rl.checks import Check
from koopdqn.robot.arm import Arm
from koopdqn.robot.mjcf import recorded_arm
from koopdqn.run_folder import CHECKPOINT
from koopdqn.settings import load_settings

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

_KIND = "checkpoint"
# Most differences and most characters of a value in a message.
_SHOWN = 4
_LONGEST = 40
_NONE = object()


def save_checkpoint(folder: Path, trainer: Trainer, shaped_by: dict[str, Any], seconds: float) -> None:
    """Save the state of a run that has taken ``seconds`` so far into its folder.

    It is resumed only with the config that shapes it.
    """
    arrays, state = trainer.state()
    about = {"shaped_by": shaped_by, "state": state, "seconds": seconds}
    write_artifact(folder / CHECKPOINT, Artifact(_KIND, arrays, about))


def latest_checkpoint(folder: Path) -> Artifact | None:
    """Return a run folder's latest checkpoint, whatever config it is of, or None if there is none yet.

    Raises:
        BadInputError: it is damaged.
    """
    path = folder / CHECKPOINT
    return read_artifact(path, _KIND) if path.exists() else None


def read_checkpoint(
    folder: Path, shaped_by: dict[str, Any], earlier: dict[str, Any] | None = None, arm: Arm | None = None
) -> Artifact | None:
    """Return a run folder's latest checkpoint, or None if there is none yet.

    Args:
        folder: the run folder.
        shaped_by: the config that determines the run.
        earlier: what an earlier version may have written down in place of ``shaped_by``.
        arm: the run's; where it is of a file, so is the checkpoint's.

    Raises:
        BadInputError: the checkpoint is damaged, or the run was begun with another config.
    """
    artifact = latest_checkpoint(folder)
    if artifact is None:
        return None
    with reading(f"checkpoint {folder / CHECKPOINT}"):
        began = dict(artifact.about["shaped_by"])
        if "intent" in began:
            # Runs of earlier commits may use old names of keys.
            began["intent"] = described(load_settings(began["intent"], IntentSettings, "intent"))
        float(artifact.about["seconds"])
        differing = [_differing(began, each, arm) for each in (shaped_by, earlier) if each]
    if all(differing):
        raise _goes_on_otherwise(folder, differing[0])
    return artifact


def check_begun(folder: Path, began: dict[str, Any], now: dict[str, Any], arm: Arm) -> None:
    """Raise BadInputError if the run of a folder ``began`` with another config of some parts than it has ``now``.

    What one of them lacks does not count: demonstrations may be made, given, or those that the folder keeps.
    """
    with reading(f"run {folder}: what it was begun with"):
        both = began.keys() & now.keys()
        was, same = ({name: held[name] for name in both} for held in (began, now))
        differing = _differing(was, same, arm)
    if differing:
        raise _goes_on_otherwise(folder, differing)


def _differing(began: dict[str, Any], now: dict[str, Any], arm: Arm | None) -> list[str]:
    was: Any = None if arm is None else recorded_arm(began["robot"], arm)
    if was is not None:
        began = {**began, "robot": described(was)}
    found = _differences("", began, json.loads(canonical_json(now)))
    # Of another task nearly everything differs.
    return [each for each in found if each.startswith("task.name ")] or found


def _goes_on_otherwise(folder: Path, differing: list[str]) -> BadInputError:
    shown = "; ".join(differing[:_SHOWN]) + (f"; and {len(differing) - _SHOWN} more" if len(differing) > _SHOWN else "")
    return BadInputError(
        f"run {folder}: can only go on with the config it began with (train.stop, train.extend and the limits may"
        f" change), found {shown}"
    )


def questions_asked(checkpoint: Artifact | None) -> int:
    """Return the number of questions asked before a checkpoint was saved; 0 where there is none.

    Raises:
        BadInputError: the checkpoint does not say.
    """
    if checkpoint is None:
        return 0
    with reading("the checkpoint"):
        return int(checkpoint.arrays["feedback/questions"])


def _differences(name: str, began: Any, now: Any) -> list[str]:
    """Return the differences of two JSON contents, with the dotted names of their keys."""
    if isinstance(began, list) and isinstance(now, list) and len(began) == len(now):
        began, now = dict(enumerate(began)), dict(enumerate(now))
    if isinstance(began, dict) and isinstance(now, dict):
        found = []
        for key in dict.fromkeys([*began, *now]):
            found += _differences(f"{name}.{key}" if name else str(key), began.get(key, _NONE), now.get(key, _NONE))
        return found
    # 1, 1.0 and true are equal in Python and different settings.
    if _text(began) == _text(now):
        return []
    return [f"{name or 'config'} {_brief(now)} instead of {_brief(began)}"]


def _text(value: Any) -> str:
    return "nothing" if value is _NONE else canonical_json(value)


def _brief(value: Any) -> str:
    text = _text(value)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"


class EventLog:
    """Writes TensorBoard events: checks by actions tried, episodes by their number. Close it."""

    def __init__(self, folder: Path, trainer: Trainer) -> None:
        """Write below ``folder/events``, from the first check on; for a resumed run only new events."""
        self._folder = folder
        self._trainer = trainer
        self._episodes = len(trainer.history.rewards)
        self._resumed_at = trainer.env_steps

    @cached_property
    def _writer(self) -> "SummaryWriter":
        # Its import would delay the first training step.
        from torch.utils.tensorboard import SummaryWriter

        return SummaryWriter(
            str(self._folder / "events"), purge_step=self._resumed_at + 1 if self._resumed_at else None
        )

    def check(self, check: Check) -> None:
        """Write a check and the episodes finished since the last."""
        history, writer = self._trainer.history, self._writer
        for number in range(self._episodes, len(history.rewards)):
            kind = "exploring" if history.exploring[number] else "whole"
            writer.add_scalar(f"reward_per_episode/{kind}", history.rewards[number], number)
        self._episodes = len(history.rewards)
        writer.add_scalar("check/success_rate", check.success_rate, check.env_steps)
        writer.add_scalar("learner/loss", history.losses[-1], check.env_steps)
        writer.add_scalar("oracle/questions", self._trainer.questions, check.env_steps)
        for source, share in history.agreement().items():
            if share is not None:
                writer.add_scalar(f"reward_agreement/{source}", share, check.env_steps)
        writer.flush()

    def close(self) -> None:
        """Close what was begun."""
        if "_writer" in vars(self):
            self._writer.close()
