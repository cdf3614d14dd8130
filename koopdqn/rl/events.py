"""TensorBoard events of a training run."""

from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

from koopdqn.rl.algorithm1 import Trainer
from koopdqn.rl.history import Check

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter


class EventLog:
    """Writes TensorBoard events: checks by actions tried, episodes by their number."""

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

        return SummaryWriter(str(self._folder / "events"), purge_step=self._resumed_at or None)

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

    def __enter__(self) -> Self:
        """Return the log."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close what was begun."""
        if "_writer" in vars(self):
            self._writer.close()
