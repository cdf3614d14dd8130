"""The reward in an environment of your own: a ball on springs in MuJoCo, with no arm at all.

Run it with ``python examples/own_environment.py 100000``: steps, then overrides. Stable-Baselines3's DQN learns to take
the ball where the bottle was carried. The Koopman model gives the reward; where it is not trusted the episode is over.
"""

import sys
from typing import Any

import gymnasium
import mujoco
import numpy as np
from stable_baselines3 import DQN

import koopdqn
from koopdqn.intent.reward import ASKED, IntentReward

JOINTS = "".join(f'<joint name="{each}" type="slide" axis="{each}"/>' for each in ("1 0 0", "0 1 0", "0 0 1"))
SPRINGS = "".join(f'<position joint="{each}" kp="1e4" kv="200"/>' for each in ("1 0 0", "0 1 0", "0 0 1"))
BALL = f'<body>{JOINTS}<geom size=".02" mass="1"/></body>'
MODEL = f'<mujoco><option gravity="0 0 0"/><worldbody>{BALL}</worldbody><actuator>{SPRINGS}</actuator></mujoco>'


class Ball(gymnasium.Env[np.ndarray, np.int64]):
    """An action of Table 1 pulls the springs' other ends, and the ball comes after them within 20 ms."""

    def __init__(self, reward: IntentReward) -> None:
        """Build the physics."""
        self.model, self.reward, self.task = mujoco.MjModel.from_xml_string(MODEL), reward, reward.task
        self.data = mujoco.MjData(self.model)
        self.observation_space = gymnasium.spaces.Box(-10.0, 10.0, (3,))
        self.action_space = gymnasium.spaces.Discrete(10)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin somewhere in the start region."""
        super().reset(seed=seed)
        self.pose, self.steps = self.task.draw_starts(self.np_random, 1)[0], 0
        self.start = self.pose.copy()
        self.data.qpos[:], self.data.qvel[:] = self.pose[:3], 0.0
        return 10.0 * (self.pose[:3] - self.task.goal[:3]).astype(np.float32), {}

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Pull for 20 ms; the reward is that of the action, whatever the ball makes of it."""
        evaluation = self.reward.evaluate_actions(self.pose[None], np.array([self.steps]), self.start[None])
        self.data.ctrl[:] = evaluation.reached[0, action, :3]
        mujoco.mj_step(self.model, self.data, 10)
        self.pose[:3], self.steps = self.data.qpos, self.steps + 1
        here, begun, lost = self.pose[None], self.start[None], bool(evaluation.source[0, action] == ASKED)
        reached, self.start = bool(self.task.arrived(here, begun)[0]), self.task.onward(here, begun)[0]
        reward, observed = -1.0 if lost else float(evaluation.reward[0, action]), self.pose[:3] - self.task.goal[:3]
        ended = lost or reached, self.steps >= 400
        return 10.0 * observed.astype(np.float32), reward, *ended, {"is_success": reached}


if __name__ == "__main__":
    config = koopdqn.load_config("task=shelf", *sys.argv[2:])
    env = Ball(koopdqn.intent_reward(config, koopdqn.fit(config, koopdqn.generate(config))))
    learner = DQN("MlpPolicy", env, gamma=0.5, learning_rate=1e-3, verbose=1, seed=0)
    learner.learn(int(sys.argv[1]), log_interval=20)
