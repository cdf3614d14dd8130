"""A guard around any policy, and speed and separation near a person."""

from koopdqn.safety.guard import Guard, GuardSettings, Refusal
from koopdqn.safety.separation import PersonNear, Separation, protective_distance, separation

__all__ = ["Guard", "GuardSettings", "PersonNear", "Refusal", "Separation", "protective_distance", "separation"]
