"""koopdqn: teach a robot arm the path a person would choose.

A Koopman model of a person's intent, fitted to a few demonstrated end-effector
trajectories, rewards a double DQN inside its trust domain; an oracle (scripted or
a person) answers elsewhere. The method is Sinha & Wang (2022),
doi:10.3389/frobt.2022.779194.
"""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("koopdqn")
except PackageNotFoundError:  # a bare checkout on PYTHONPATH
    __version__ = "0+unknown"

__all__ = ["__version__"]
