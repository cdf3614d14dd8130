"""The environment as dm_env knows it: one episode, one action at a time."""

from functools import cached_property
from typing import Any

import dm_env
import numpy as np
from dm_env import specs

from koopdqn.envs.batch import Batch, EnvironmentParts
from koopdqn.pose import Array
from koopdqn.rl.network import size
from koopdqn.tasks.actions import COUNT


class KoopmanEnvironment(dm_env.Environment):  # type: ignore[misc]  # dm_env is untyped
    """Algorithm 1's environment: rewards from the intent model where trusted, from the oracle elsewhere.

    A wrong action is rewarded negatively and undone: the next observation is that of the pose before it, and
    the agent can try another. An action that the arm cannot take counts as wrong without asking. An episode
    ends with discount 0 at the goal, and with discount 1 when it is cut at its step limit. It is one episode of
    :class:`~koopdqn.rl.vector_env.VectorEnv`, which training uses. ``dm_control.viewer`` opens it.
    """

    def __init__(self, parts: EnvironmentParts, seed: int) -> None:
        """Make the environment of its parts; ``seed`` is of the starts."""
        self._parts = parts
        self._batch = Batch(parts, 1, np.random.default_rng([seed, 5]))
        self._fresh = True
        self._running = False

    @property
    def pose(self) -> Array:
        """The flange's present pose (7,)."""
        return np.asarray(self._batch.poses[0])

    @cached_property
    def physics(self) -> Any:
        """The scene as ``dm_control.viewer`` shows it; the arm in it follows the episode, and nothing else moves."""
        from dm_control.mujoco import Physics, wrapper

        physics = Physics.from_model(wrapper.MjModel(self._parts.workcell.scene.model))
        self._place(physics)
        return physics

    def reset(self) -> dm_env.TimeStep:
        """Begin an episode somewhere in the start region."""
        if not self._fresh:
            self._batch.begin(0)
        self._fresh = False
        self._running = True
        self._show(None)
        return dm_env.restart(self._batch.observations()[0])

    def step(self, action: Any) -> dm_env.TimeStep:
        """Try an action (an index in Table 1 or a twist); a skipped question brings reward 0 and moves nothing.

        Raises:
            ValueError: the action is none of the ten.
            PauseRequested: who answers wants to go on another time.
        """
        if not self._running:
            return self.reset()
        steps = self._batch.step_only(action)
        self._show(self._parts.workcell.arm.step_seconds)
        reward, observation = float(steps.rewards[0]), self._batch.observations()[0]
        self._running = not (steps.terminated[0] or steps.truncated[0])
        if steps.terminated[0]:
            return dm_env.termination(reward, observation)
        if steps.truncated[0]:
            return dm_env.truncation(reward, observation)
        return dm_env.transition(reward, observation)

    def observation_spec(self) -> specs.Array:
        """Return the observation's shape: (5,) with orientation held, (8,) otherwise."""
        return specs.Array((size(self._parts.workcell.task),), np.float32, name="observation")

    def action_spec(self) -> specs.Array:
        """Return the ten actions, or, where they are continuous, a twist's numbers, each from −1 to 1."""
        if self._parts.twist:
            return specs.BoundedArray((self._parts.twist,), np.float32, -1.0, 1.0, name="action")
        return specs.DiscreteArray(COUNT, name="action")

    def close(self) -> None:
        """Close the oracle."""
        self._parts.oracle.close()

    def _show(self, elapsed: float | None) -> None:
        """Let :attr:`physics`, if anybody looks at it, follow the arm; ``elapsed`` [s] is None for a new episode."""
        if "physics" not in self.__dict__:
            return
        data = self.physics.data
        data.time = 0.0 if elapsed is None else data.time + elapsed
        self._place(self.physics)

    def _place(self, physics: Any) -> None:
        physics.data.qpos[self._parts.workcell.scene.joint_index] = self._batch.joints[0]
        physics.forward()
