"""The reward in a loop of your own: tabular Q-learning on a coarse grid, rewarded by the Koopman model alone.

Run it with ``python examples/reward_in_another_loop.py 60``: episodes, then overrides.
"""

import sys
from collections import defaultdict

import numpy as np

import koopdqn
from koopdqn.pose import Array

CELL_M = 0.01
STEPS, GAMMA, RATE = 300, 0.5, 0.5


def cell_of(pose: Array) -> tuple[int, ...]:
    """Return the grid cell of a pose (7,)."""
    return tuple(np.round(pose[:3] / CELL_M).astype(int).tolist())


if __name__ == "__main__":
    config = koopdqn.load_config("task=shelf", *sys.argv[2:])
    intent = koopdqn.fit(config, koopdqn.generate(config))
    reward = koopdqn.intent_reward(config, intent)
    rng = np.random.default_rng(config.inputs.seed)
    table: dict[tuple[int, ...], Array] = defaultdict(lambda: np.zeros(10))
    for episode in range(int(sys.argv[1])):
        here = start = config.task.draw_starts(rng, 1)[0]
        right = step = 0
        for step in range(STEPS):
            evaluation = reward.evaluate_actions(here[None], np.array([step]), start[None])
            known = evaluation.known[0]
            values = np.where(known, table[cell_of(here)], -np.inf)
            action = int(rng.choice(np.flatnonzero(values == values.max())))
            there, given = evaluation.reached[0, action], float(evaluation.reward[0, action])
            ahead = 0.0 if given < 0 else GAMMA * float(table[cell_of(there)].max())
            table[cell_of(here)][action] += RATE * (given + ahead - table[cell_of(here)][action])
            right += given >= 0
            if given >= 0:
                here, start = there, config.task.onward(there[None], start[None])[0]
            if evaluation.at_goal[0, action] and given >= 0:
                break
        if episode % 10 == 9:
            print(f"episode {episode + 1}: {right / (step + 1):.0%} of {step + 1} actions right")
