"""Speed of Gymnasium's environment of many episodes, beside as many environments of one episode."""

import time
from statistics import median
from typing import Any

import numpy as np

from benchmarks.rows import NOT_INSTALLED, Row, installed
from koopdqn.tasks.actions import COUNT

_EPISODES = 256
_MICRO = 1e6


def row(steps: int = 40) -> Row:
    """Return the row of one episode's step, along the intent model's best actions with a tenth of them random."""
    theirs: float | str = NOT_INSTALLED
    if not installed("gymnasium"):
        return Row("a step of an environment", None, "µs", "as many environments of one episode", theirs)
    import gymnasium

    import koopdqn.gym

    name = "koopdqn/Shelf-v0"
    together = gymnasium.make_vec(name, _EPISODES)
    alone = gymnasium.make_vec(name, 8, vectorization_mode="sync")
    reward = koopdqn.gym.environment_parts("shelf").reward
    mine, other = (_seconds(each, reward, steps) for each in (together, alone))
    what = f"a step of Gymnasium's environment, {_EPISODES} episodes at once"
    note = f"{1 / mine:,.0f} steps a second; all that a step does, questions to the scripted person included"
    return Row(what, mine * _MICRO, "µs", "Gymnasium's `SyncVectorEnv` of ours", other * _MICRO, note=note)


def _seconds(env: Any, reward: Any, steps: int) -> float:
    """Return the median time [s] of a step of one episode."""
    rng, count = np.random.default_rng(0), env.num_envs
    where = env.reset(seed=0)[1]["pose"]
    starts, none_made, times = np.array(where), np.zeros(count, dtype=np.int64), []
    for _ in range(steps):
        best = reward.evaluate_actions(np.array(where), none_made, starts).margin.argmax(axis=1)
        actions = np.where(rng.random(count) < 0.1, rng.integers(COUNT, size=count), best)
        began = time.perf_counter()
        where = env.step(actions)[4]["pose"]
        times.append((time.perf_counter() - began) / count)
    env.close()
    return float(median(times))
