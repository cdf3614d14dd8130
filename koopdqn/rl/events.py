"""TensorBoard events of a training run."""

from pathlib import Path

from torch.utils.tensorboard import SummaryWriter

from koopdqn.rl.algorithm1 import Trainer
from koopdqn.rl.history import Check


class EventLog(SummaryWriter):
    """Writes TensorBoard events: checks by actions tried, episodes by their number."""

    def __init__(self, folder: Path, trainer: Trainer) -> None:
        """Write below ``folder/events``; for a resumed run only new events."""
        self._trainer = trainer
        self._episodes = len(trainer.history.rewards)
        super().__init__(str(folder / "events"), purge_step=trainer.env_steps or None)

    def check(self, check: Check) -> None:
        """Write a check and the episodes finished since the last."""
        history = self._trainer.history
        for number in range(self._episodes, len(history.rewards)):
            kind = "exploring" if history.exploring[number] else "whole"
            self.add_scalar(f"reward_per_episode/{kind}", history.rewards[number], number)
        self._episodes = len(history.rewards)
        self.add_scalar("check/success_rate", check.success_rate, check.env_steps)
        self.add_scalar("learner/loss", history.losses[-1], check.env_steps)
        self.add_scalar("oracle/questions", self._trainer.questions, check.env_steps)
        for source, share in history.agreement().items():
            if share is not None:
                self.add_scalar(f"reward_agreement/{source}", share, check.env_steps)
        self.flush()
