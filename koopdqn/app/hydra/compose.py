"""Composing the config tree once more, and saying in one line what Hydra or OmegaConf refuse."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, Any, Final

from koopdqn.app.hydra.folder import ensure_resolver
from koopdqn.app.hydra.record import GROUPS
from koopdqn.console import shown_path
from koopdqn.errors import BadInputError, KoopdqnError, WorkFailedError, unknown_name
from koopdqn.files import OUT_OF_ROOM
from koopdqn.resources import conf_dir
from koopdqn.settings import shown

if TYPE_CHECKING:
    from omegaconf import DictConfig


def composed(overrides: Sequence[str], replaced: Mapping[str, Any] | None = None) -> "DictConfig":
    """Return the config tree under overrides, in Hydra's grammar.

    Within a command it is composed from where the command's own config came from, so that a user's own config
    folder takes part. Another program's own use of Hydra is left as it was, and what Hydra raises for an override that
    it refuses is passed on. The top-level keys ``replaced`` are put in place of the composed ones; what refers to them
    by ``${…}`` follows.
    """
    from hydra import compose
    from omegaconf import OmegaConf

    with _LOCK, _initialized() as name:
        ensure_resolver()
        config = compose(name, overrides=list(overrides))
    OmegaConf.set_struct(config, False)
    for key, value in (replaced or {}).items():
        config[key] = value
    return config


# Keys that commands set themselves, and what the command line takes beside the config's own keys.
_NO_KEYS: Final = {"hydra", "command", "intent_file", "trust_modules"}
_MORE_KEYS: Final = ("preset", "obstacles")

# What Hydra knows is one for all threads.
_LOCK: Final = RLock()


@contextmanager
def _initialized() -> Iterator[str]:
    """Let Hydra compose from the config tree, and put back what another program had it compose from.

    Yields the name of the config to compose, which a command may have another of.
    """
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.hydra_config import HydraConfig
    from hydra.version import VersionBase

    here, base = GlobalHydra.instance(), VersionBase.instance()
    if here.is_initialized() and set(GROUPS) <= set(here.config_loader().list_groups("")):
        command = HydraConfig.get().job.config_name if HydraConfig.initialized() else None
        yield command or "config"
        return
    before = here.hydra, base.version_base
    here.clear()
    try:
        with initialize_config_dir(str(conf_dir()), version_base="1.3"):
            yield "config"
    finally:
        here.hydra, base.version_base = before
        GlobalHydra.set_instance(here)


_NOISE = ("See https://", "object_type=", "reference_type=", "full_key:")
_TORCH_ALLOCATOR = "can't allocate memory"


_EXTRAS: Final = {
    "joblib": "joblib",
    "submitit_slurm": "slurm",
    "submitit_local": "slurm",
    "ray": "ray",
    "optuna": "optuna",
}
"""The extra that brings each launcher and sweeper."""


def explain(error: BaseException) -> KoopdqnError | None:
    """Return the error that tells the user what ``error`` means, or None if it is a fault of the program.

    The cause is looked for along the chain of ``__cause__`` and ``__context__``, since Hydra and OmegaConf
    wrap what their callers raise.
    """
    for link in _chain(error):
        if isinstance(link, KoopdqnError):
            return link
    for link in _chain(error):
        known = _from_hydra(link) or _from_yaml(link) or _raised_by_hydra(link)
        if known:
            return known
    return _from_system(error) if isinstance(error, OSError) else _from_computation(error)


def _from_computation(error: BaseException) -> WorkFailedError | None:
    # by name, so that NumPy need not be loaded to say what a misspelt override is
    if type(error).__name__ == "LinAlgError":
        return WorkFailedError(f"the numbers diverged: {_in_one_line(str(error))}")
    # torch has no class of its own for it on the CPU
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and _TORCH_ALLOCATOR in str(error)):
        return WorkFailedError(f"this machine's memory does not suffice: {_in_one_line(str(error)) or 'none is left'}")
    return None


def _chain(error: BaseException) -> Iterator[BaseException]:
    link: BaseException | None = error
    while link is not None:
        yield link
        link = link.__cause__ or (None if link.__suppress_context__ else link.__context__)


def _from_hydra(error: BaseException) -> BadInputError | None:
    from hydra.errors import HydraException, MissingConfigException, OverrideParseException
    from omegaconf.errors import OmegaConfBaseException

    if isinstance(error, OverrideParseException):
        reason = _in_one_line(error.message)
        if reason.startswith("LexerNoViableAlt"):
            reason = "a character in it must stand in quotes, as in key='value'"
        return BadInputError(f"the override {shown(error.override)} cannot be read: {reason}")
    if isinstance(error, MissingConfigException):
        return _missing_config(error)
    cause = error.__cause__
    if isinstance(error, HydraException):
        text = _in_one_line(str(error))
        if isinstance(cause, OmegaConfBaseException):
            known = _from_omegaconf(cause)
            merging = text.startswith("Error merging override")
            return BadInputError(f"{text}: {known}") if merging else known
        return BadInputError(text or "the config cannot be composed") if text or cause is None else None
    if isinstance(error, OmegaConfBaseException):
        return _from_omegaconf(error)
    return None


def _missing_config(error: BaseException) -> BadInputError:
    name = getattr(error, "missing_cfg_file", None)
    options = getattr(error, "options", None)
    if name and options is not None:
        group, _, option = str(name).rpartition("/")
        if group.startswith("hydra/") and option in _EXTRAS:
            extra = f"koopdqn[{_EXTRAS[option]}]"
            return BadInputError(f"{group}={option} needs an extra, found it not installed: pip install '{extra}'")
        kind = f"option of {group}" if group else "config"
        return unknown_name(kind, option, options) if options else BadInputError(f"no config group {group!r} ({name})")
    return BadInputError(_in_one_line(str(error)))


def _from_omegaconf(error: BaseException) -> BadInputError:
    from omegaconf import DictConfig
    from omegaconf.errors import ConfigAttributeError, ConfigKeyError, MissingMandatoryValue

    key = getattr(error, "full_key", None) or ""
    if isinstance(error, MissingMandatoryValue):
        return BadInputError(f"{key}: must be given, found ??? (nothing)")
    parent = getattr(error, "parent_node", None)
    if isinstance(error, ConfigAttributeError | ConfigKeyError) and isinstance(parent, DictConfig):
        held = {str(name) for name in parent} - _NO_KEYS
        valid = sorted(held if "." in key else held | set(_MORE_KEYS))
        return BadInputError(f"unknown key {key}; valid: {', '.join(valid) or 'none'}")
    text = _in_one_line(str(error))
    # OmegaConf keeps of a resolver's error only its class's name and text
    resolver, marker, message = text.partition(" raised while resolving interpolation: ")
    if marker and resolver == BadInputError.__name__:
        return BadInputError(message)
    return BadInputError(f"{key}: {text}" if key else text)


def _raised_by_hydra(error: BaseException) -> BadInputError | None:
    """Return the error of Hydra's own checks that raise ValueError, which a job may raise by a fault too."""
    if isinstance(error, UnicodeDecodeError):
        return BadInputError(
            f"a text file must be UTF-8, found byte 0x{error.object[error.start]:02x} at {error.start}"
        )
    if not isinstance(error, ValueError):
        return None
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    module = str(trace.tb_frame.f_globals.get("__name__", "")) if trace else ""
    return BadInputError(_in_one_line(str(error))) if module.partition(".")[0] in ("hydra", "omegaconf") else None


def _from_yaml(error: BaseException) -> BadInputError | None:
    # YAML's own classes, told by their package: it ships no type hints
    if not type(error).__module__.startswith("yaml."):
        return None
    return BadInputError(f"a config file is not valid YAML: {_in_one_line(str(error))}")


def _from_system(error: OSError) -> KoopdqnError:
    reason = error.strerror or _in_one_line(str(error)) or type(error).__name__
    text = f"{shown_path(Path(str(error.filename)))}: {reason}" if error.filename else reason
    if error.errno is None or error.errno in OUT_OF_ROOM:
        return WorkFailedError(text)
    return BadInputError(text)


def _in_one_line(text: str) -> str:
    lines = []
    for line in text.splitlines():
        line = line.strip()
        if line.startswith(("Config search path:", "Search path:")):
            break
        if line and not line.startswith(_NOISE):
            lines.append(line)
    return " ".join(lines)
