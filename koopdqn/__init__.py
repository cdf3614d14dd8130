"""koopdqn: teach a robot arm the path a person would choose.

A Koopman model of a person's intent, fitted to a few demonstrated end-effector
trajectories, rewards a double DQN inside its trust domain; an oracle (scripted or
a person) answers elsewhere. The method is Sinha & Wang (2022),
doi:10.3389/frobt.2022.779194.

The names below are the API; each is imported when it is first used.
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from koopdqn.app.api import (
        Trained,
        evaluate,
        fit,
        generate,
        intent_reward,
        load_config,
        make_env,
        open_workcell,
        train,
    )
    from koopdqn.demonstrations.reading import read_demonstrations
    from koopdqn.intent.reward import IntentReward
    from koopdqn.rl.policy import Policy, read_policy

try:
    __version__ = version("koopdqn")
except PackageNotFoundError:  # a bare checkout on PYTHONPATH
    __version__ = "0+unknown"

_PLACES = {
    "koopdqn.app.api": (
        "Trained",
        "evaluate",
        "fit",
        "generate",
        "intent_reward",
        "load_config",
        "make_env",
        "open_workcell",
        "train",
    ),
    "koopdqn.demonstrations.reading": ("read_demonstrations",),
    "koopdqn.intent.reward": ("IntentReward",),
    "koopdqn.rl.policy": ("Policy", "read_policy"),
}
_PLACE_OF = {name: place for place, names in _PLACES.items() for name in names}

__all__ = [
    "IntentReward",
    "Policy",
    "Trained",
    "__version__",
    "evaluate",
    "fit",
    "generate",
    "intent_reward",
    "load_config",
    "make_env",
    "open_workcell",
    "read_demonstrations",
    "read_policy",
    "train",
]


def __getattr__(name: str) -> Any:
    """Import a name of the API when it is first used."""
    if name not in _PLACE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_PLACE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
