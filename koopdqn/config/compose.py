"""Composing the config tree once more beside the one a command was given."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from koopdqn.config.folder import ensure_resolver
from koopdqn.config.resources import conf_dir

if TYPE_CHECKING:
    from omegaconf import DictConfig


def composed(overrides: Sequence[str], replaced: Mapping[str, Any] | None = None) -> "DictConfig":
    """Return the config tree under overrides, in Hydra's grammar.

    Within a command it is composed from where the command's own config came from, so that a user's own config
    folder takes part.

    Args:
        overrides: as on the command line.
        replaced: top-level keys put in place of the composed ones; what refers to them by ``${…}`` follows.

    Raises:
        Exception: whatever Hydra raises for an override that it refuses.
    """
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from omegaconf import OmegaConf

    ensure_resolver()
    if GlobalHydra.instance().is_initialized():
        config = compose("config", overrides=list(overrides))
    else:
        with initialize_config_dir(str(conf_dir()), version_base="1.3"):
            config = compose("config", overrides=list(overrides))
    OmegaConf.set_struct(config, False)
    for key, value in (replaced or {}).items():
        config[key] = value
    return config
