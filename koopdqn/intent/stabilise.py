"""Stabilisation: made-up pairs that lead back to the demonstrations."""

import numpy as np
from pydantic import Field

from koopdqn.config.settings import Settings
from koopdqn.pose import Array


class Stabilisation(Settings):
    """How the demonstrations are surrounded by states that lead back to them."""

    copies: int = Field(ge=0, le=100, description="made-up pairs for each demonstrated one; 0 for none")
    pull_back_m: float = Field(gt=0, description="distance over which a made-up pair leads back [m]")
    spread: float = Field(
        gt=0, le=10, description="standard deviation of a made-up state's sideways offset, in pull_back_m"
    )
    seed: int = Field(ge=0)


def surrounded(before: Array, after: Array, settings: Stabilisation) -> tuple[Array, Array]:
    """Return pairs of positions (M, 3) [m] with ``copies`` made-up pairs added for each.

    A made-up state lies beside a demonstrated one, at right angles to the motion there. Its successor
    is a step of the demonstrated length in the direction of the demonstrated motion, turned back to
    the demonstration so that the offset dies out over ``pull_back_m``.
    """
    rng = np.random.default_rng(settings.seed)
    befores, afters = [before], [after]
    motion = after - before
    length = np.linalg.norm(motion, axis=1, keepdims=True)
    moving = length[:, 0] > 1e-9
    before, motion, length = before[moving], motion[moving], length[moving]
    direction = motion / length
    for _ in range(settings.copies):
        offset = rng.normal(scale=settings.spread * settings.pull_back_m, size=before.shape)
        offset -= (offset * direction).sum(axis=1, keepdims=True) * direction
        back = direction - offset / settings.pull_back_m
        back /= np.linalg.norm(back, axis=1, keepdims=True)
        befores.append(before + offset)
        afters.append(before + offset + length * back)
    return np.concatenate(befores), np.concatenate(afters)
