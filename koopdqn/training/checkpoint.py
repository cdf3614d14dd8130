"""Checkpoints: everything a run needs to go on, in one file that appears whole or not at all."""

from pathlib import Path
from typing import Any

from koopdqn.artifact import Artifact, read_artifact, write_artifact
from koopdqn.errors import BadInputError
from koopdqn.files import digest
from koopdqn.training.trainer import Trainer

KIND = "checkpoint"


def checkpoint_path(folder: Path) -> Path:
    """Return where a run folder keeps its latest checkpoint."""
    return folder / "checkpoints" / "latest.safetensors"


def save_checkpoint(folder: Path, trainer: Trainer, shaped_by: dict[str, Any], seconds: float) -> None:
    """Save a trainer's state.

    Args:
        folder: the run folder.
        trainer: the run.
        shaped_by: the config that decides what the run does; a run goes on only with the same.
        seconds: how long the run has taken so far.
    """
    arrays, state = trainer.state()
    about = {"shaped_by": digest(shaped_by), "state": state, "seconds": seconds}
    write_artifact(checkpoint_path(folder), Artifact(KIND, arrays, about))


def read_checkpoint(folder: Path, shaped_by: dict[str, Any]) -> Artifact | None:
    """Return a run folder's latest checkpoint, or None if it was stopped before the first.

    Raises:
        BadInputError: the checkpoint is damaged, or the run was shaped by another config.
    """
    path = checkpoint_path(folder)
    if not path.exists():
        return None
    artifact = read_artifact(path, KIND)
    if artifact.about["shaped_by"] != digest(shaped_by):
        raise BadInputError(
            f"run {folder}: can only go on with the config it began with (train.stop, train.extend and the limits may"
            " change), found another"
        )
    return artifact
