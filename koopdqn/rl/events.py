"""TensorBoard events of a training run."""

from pathlib import Path
from types import TracebackType
from typing import Self

from torch.utils.tensorboard import SummaryWriter

from koopdqn.rl.algorithm1 import Trainer
from koopdqn.rl.history import Check


class EventLog:
    """Writes what TensorBoard shows: checks against actions tried, episodes against their number."""

    def __init__(self, folder: Path, trainer: Trainer) -> None:
        """Write below ``folder/events``; of a continued run only what is new."""
        self._trainer = trainer
        self._episodes = len(trainer.history.rewards)
        self._writer = SummaryWriter(str(folder / "events"), purge_step=trainer.env_steps or None)

    def check(self, check: Check) -> None:
        """Write a check and the episodes finished since the last."""
        history = self._trainer.history
        for number in range(self._episodes, len(history.rewards)):
            kind = "exploring" if history.exploring[number] else "whole"
            self._writer.add_scalar(f"reward_per_episode/{kind}", history.rewards[number], number)
        self._episodes = len(history.rewards)
        self._writer.add_scalar("check/success_rate", check.success_rate, check.env_steps)
        self._writer.add_scalar("learner/loss", history.losses[-1], check.env_steps)
        self._writer.add_scalar("oracle/questions", self._trainer.questions, check.env_steps)
        for source, share in history.agreement().items():
            if share is not None:
                self._writer.add_scalar(f"reward_agreement/{source}", share, check.env_steps)
        self._writer.flush()

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the file."""
        self._writer.close()
