"""Composing the config tree once more beside the one a command was given."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from koopdqn.config.resources import conf_dir

if TYPE_CHECKING:
    from omegaconf import DictConfig


def composed(overrides: Sequence[str]) -> "DictConfig":
    """Return the config tree under overrides, in Hydra's grammar.

    Within a command it is composed from where the command's own config came from, so that a user's own config
    folder takes part.

    Raises:
        Exception: whatever Hydra raises for an override that it refuses.
    """
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra

    if GlobalHydra.instance().is_initialized():
        return compose("config", overrides=list(overrides))
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        return compose("config", overrides=list(overrides))
