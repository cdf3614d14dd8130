"""What a method that learns from demonstrations alone ends with."""

from dataclasses import dataclass

from koopdqn.dqn.policy import Policy


@dataclass(frozen=True)
class Imitator:
    """A policy learned from demonstrations alone.

    Attributes:
        policy: the argmax of its network.
        updates: updates of the network.
        env_steps: actions tried in the environment.
    """

    policy: Policy
    updates: int
    env_steps: int
