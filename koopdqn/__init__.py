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


_ELSEWHERE = {
    "IntentReward": "koopdqn.intent.reward",
    "Policy": "koopdqn.rl.policy",
    "read_demonstrations": "koopdqn.demonstrations.reading",
    "read_policy": "koopdqn.rl.policy",
}
"""Where the names are that are not in koopdqn.app.api."""


def __getattr__(name: str) -> Any:
    """Import a name of the API when it is first used."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_ELSEWHERE.get(name, "koopdqn.app.api")), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
