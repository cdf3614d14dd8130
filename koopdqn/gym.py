"""koopdqn for Gymnasium: importing this module registers its environments.

``gymnasium.make("koopdqn/Shelf-v0")``, ``"koopdqn/Knife-v0"`` and ``"koopdqn/Demonstrated-v0"``, each also with
continuous actions, as ``"koopdqn/ShelfContinuous-v0"``, and ``gymnasium.make_vec`` of the same names for many episodes
at once. All take the keywords of :func:`environment_parts`, and ``render_mode``.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from koopdqn.errors import BadInputError
from koopdqn.files import digest
from koopdqn.settings import shown

try:
    import gymnasium
except ImportError as error:
    raise BadInputError("koopdqn.gym needs Gymnasium, found none: pip install 'koopdqn[gym]'") from error

if TYPE_CHECKING:
    from koopdqn.app.commands.configuration import Configuration
    from koopdqn.demonstrations.dataset import Demonstrations
    from koopdqn.envs.batch import EnvironmentParts
    from koopdqn.envs.gym import KoopmanEnv, KoopmanVectorEnv, RenderMode
    from koopdqn.intent.fit import Fitted
    from koopdqn.oracles.base import Oracle

TASKS: Final = {"koopdqn/Shelf-v0": "shelf", "koopdqn/Knife-v0": "knife", "koopdqn/Demonstrated-v0": "demonstrated"}
"""The task of each environment by its name."""

for _name, _task in TASKS.items():
    for _kind, _actions in (("", "table1"), ("Continuous", "continuous")):
        gymnasium.register(
            _name.replace("-", f"{_kind}-"),
            f"{__name__}:make",
            vector_entry_point=f"{__name__}:make_vector",
            kwargs={"task": _task, "actions": _actions},
        )


def make(task: str, *, render_mode: "RenderMode | None" = None, **parts: Any) -> "KoopmanEnv":
    """Return the environment of one episode at a time; ``parts`` are the keywords of :func:`environment_parts`.

    Raises:
        BadInputError: an override or file cannot be used, or ``render_mode`` is neither ``rgb_array`` nor ``human``.
    """
    from koopdqn.envs.gym import KoopmanEnv

    return KoopmanEnv(environment_parts(task, **parts), render_mode)


def make_vector(num_envs: int, task: str, **keywords: Any) -> "KoopmanVectorEnv":
    """Return the environment of ``num_envs`` episodes at once; see :func:`make`.

    ``keywords`` may hold ``autoreset_mode`` too, and ``render_mode`` is ``rgb_array`` only.
    """
    from koopdqn.envs.gym import KoopmanVectorEnv

    own = {name: keywords.pop(name) for name in ("autoreset_mode", "render_mode") if name in keywords}
    return KoopmanVectorEnv(environment_parts(task, **keywords), num_envs, **own)


def environment_parts(
    task: str,
    overrides: str | Iterable[str] = (),
    demonstrations: str | Path | Iterable[str | Path] | None = None,
    oracle: "Oracle | None" = None,
    config_dir: str | Path | None = None,
    actions: str = "table1",
    exploring_starts: bool = False,
) -> "EnvironmentParts":
    """Return what the environment of a task consists of.

    Demonstrations are read, or generated, and the intent is fitted to them; within a process each is made once.

    Args:
        task: an option of the config group ``task``.
        overrides: of the config, in Hydra's grammar, such as ``("seed=3", "demo.count=3")``.
        demonstrations: files, as ``demos=`` names them on the command line; ``Demonstrated-v0`` must have some.
        oracle: who answers where the intent is not trusted; None for the config's, which is the scripted person.
        config_dir: a folder of own options, searched beside koopdqn's.
        actions: ``table1`` or ``continuous``.
        exploring_starts: whether episodes begin as in koopdqn's own training: most of them short, in and around the
            start region or along a demonstration, as the config's ``agent.exploring_…`` say.

    Raises:
        BadInputError: an override or file cannot be used.
    """
    from koopdqn.app import api

    more = [overrides] if isinstance(overrides, str) else overrides
    if not isinstance(more, Iterable) or isinstance(more, Mapping):
        raise BadInputError(f"overrides: must be a text such as 'seed=3', or several, found {shown(overrides)}")
    config = api.load_config(
        f"task={task}", f"actions={actions}", *_demos(demonstrations), *more, config_dir=config_dir
    )
    return api.environment_parts(config, *_fitted(config), oracle, exploring_starts=exploring_starts)


_FITTED: "dict[str, tuple[Demonstrations, Fitted]]" = {}


def _fitted(config: "Configuration") -> "tuple[Demonstrations, Fitted]":
    """Return the demonstrations of a config and the intent fitted to them, of this process's earlier ones if equal."""
    from koopdqn.app import api
    from koopdqn.artifact import described

    read = api.generate(config) if config.inputs.demos else None
    parts = ("task", "robot", "demo", "intent", "trust", "reward")
    shaped_by = {name: described(getattr(config, name)) for name in parts}
    key = digest({**shaped_by, "seed": config.inputs.seed, "demonstrations": read.digest() if read else None})
    if key not in _FITTED:
        shown = read or api.generate(config)
        _FITTED[key] = shown, api.fit(config, shown)
    return _FITTED[key]


def _demos(files: str | Path | Iterable[str | Path] | None) -> list[str]:
    """Return the override that names files of demonstrations, in Hydra's grammar."""
    if files is None:
        return []
    from koopdqn.app.hydra.overrides import literal

    named = [files] if isinstance(files, str | Path) else files
    if not isinstance(named, Iterable) or isinstance(named, Mapping):
        raise BadInputError(f"demonstrations: must be a file or several, found {named!r}")
    return [f"demos=[{','.join(literal(str(each)) for each in named)}]"]
