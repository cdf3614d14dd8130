"""What a method that learns without intent model and reward ends with."""

from dataclasses import dataclass

from koopdqn.rl.policy import Policy


@dataclass(frozen=True)
class Imitator:
    """A policy learned from demonstrations, and from an expert's labels where the method asks for some.

    Attributes:
        policy: the argmax of its network.
        updates: updates of the network.
        env_steps: actions tried in the environment.
        questions: labels that an expert was asked for.
    """

    policy: Policy
    updates: int
    env_steps: int
    questions: int = 0
