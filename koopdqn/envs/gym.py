"""The environment as Gymnasium knows it: one episode, or many at once over arrays."""

from typing import Any, ClassVar, Literal

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from koopdqn.envs.batch import SOURCE_NAMES, Batch, EnvironmentParts, Steps
from koopdqn.envs.display import Pictures, Window, check_render_mode, render_modes
from koopdqn.errors import BadInputError, unknown_name
from koopdqn.robot.render import Image
from koopdqn.settings import shown
from koopdqn.tasks.actions import COUNT
from koopdqn.tasks.workcell import Workcell

RenderMode = Literal["human", "rgb_array"]
Observations = NDArray[np.float32]


class KoopmanEnv(gymnasium.Env[Observations, Any]):
    """Algorithm 1's environment: rewards from the intent model where trusted, from the oracle elsewhere.

    A wrong action is rewarded negatively and undone: the next observation is that of the pose before it. An episode is
    terminated at the goal and truncated at its step limit. ``reset(seed=…)`` makes all as new: starts, and what
    answers have taught; so the same seed and actions give the same rewards.

    ``info`` holds ``pose`` (7,), and after a step ``source`` (where the reward comes from), ``undone`` (whether the
    arm is where it was) and ``is_success`` (whether the goal was reached).
    """

    def __init__(self, parts: EnvironmentParts, render_mode: RenderMode | None = None) -> None:
        """Make the environment.

        Raises:
            BadInputError: ``render_mode`` is none, or ``human`` where there is no display.
        """
        self.metadata = {"render_modes": render_modes(), "render_fps": _frames_per_second(parts.workcell)}
        check_render_mode(render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        self.observation_space = observation_space(parts.workcell)
        self.action_space = action_space(parts)
        self._parts = parts
        self._batch: Batch | None = None
        self._pictures: Pictures | None = None
        self._window: Window | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Begin an episode at a start that is drawn; there are no options."""
        super().reset(seed=seed)
        _check_no_options(options)
        if self._batch is None or seed is not None:
            self._batch = Batch(self._parts, 1, self.np_random)
        else:
            self._batch.begin(0)
        self._show()
        return self._batch.observations()[0], {"pose": self._batch.poses[0]}

    def step(self, action: Any) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Try an action (an index in Table 1 or a twist); a skipped question brings reward 0 and moves nothing.

        Raises:
            ValueError: the action is none of the ten.
            PauseRequested: who answers wants to go on another time.
        """
        batch = self._begun()
        steps = batch.step_only(action)
        self._show()
        info = {
            "source": str(SOURCE_NAMES[steps.sources[0]]),
            "undone": bool(steps.undone[0]),
            "is_success": bool(steps.terminated[0]),
            "pose": batch.poses[0],
        }
        ended = bool(steps.terminated[0]), bool(steps.truncated[0])
        return batch.observations()[0], float(steps.rewards[0]), *ended, info

    def render(self) -> Image | None:
        """Return a picture (480, 640, 3) in the mode ``rgb_array``, None otherwise.

        Raises:
            WorkFailedError: OpenGL does not work here.
        """
        if self.render_mode != "rgb_array":
            return None
        self._pictures = self._pictures or Pictures(self._parts.workcell)
        return self._pictures.picture(self._begun().joints[0])

    def close(self) -> None:
        """Close the window, free what OpenGL holds, and close the oracle."""
        for each in (self._pictures, self._window):
            if each is not None:
                each.close()
        self._pictures = self._window = None
        self._parts.oracle.close()

    def _begun(self) -> Batch:
        if self._batch is None:
            raise gymnasium.error.ResetNeeded("reset() must be called before step() and render(), found it was not")
        return self._batch

    def _show(self) -> None:
        if self.render_mode == "human":
            self._window = self._window or Window(self._parts.workcell)
            self._window.show(self._begun().joints[0])


class KoopmanVectorEnv(gymnasium.vector.VectorEnv[Observations, np.ndarray, np.ndarray]):
    """N episodes of :class:`KoopmanEnv` at once, with arrays: labels, kinematics and collisions of all in one go.

    They share their seed, and what answers have taught. An episode that has ended begins anew with the next step
    (``AutoresetMode.NEXT_STEP``, whose action is then ignored), or with the same (``SAME_STEP``: ``final_obs`` and
    ``final_info`` tell how it ended).
    """

    modes: ClassVar = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)

    def __init__(
        self,
        parts: EnvironmentParts,
        num_envs: int,
        render_mode: Literal["rgb_array"] | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ) -> None:
        """Make ``num_envs`` episodes.

        Raises:
            BadInputError: ``num_envs``, ``render_mode`` or ``autoreset_mode`` is none that there can be.
        """
        names = [mode.value for mode in self.modes]
        if autoreset_mode not in (*self.modes, *names):
            raise unknown_name("autoreset_mode", getattr(autoreset_mode, "value", autoreset_mode), names)
        if not isinstance(num_envs, int | np.integer) or num_envs < 1:
            raise BadInputError(f"num_envs: must be a whole number, 1 or above, found {shown(num_envs)}")
        check_render_mode(render_mode, ["rgb_array"])
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": _frames_per_second(parts.workcell),
            "autoreset_mode": AutoresetMode(autoreset_mode),
        }
        self.single_observation_space = observation_space(parts.workcell)
        self.single_action_space = action_space(parts)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._parts = parts
        self._batch: Batch | None = None
        self._ended = np.zeros(num_envs, dtype=bool)
        self._pictures: Pictures | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Begin all episodes anew; there are no options."""
        super().reset(seed=seed)
        _check_no_options(options)
        if self._batch is None or seed is not None:
            self._batch = Batch(self._parts, self.num_envs, self.np_random)
        else:
            self._begin(np.ones(self.num_envs, dtype=bool))
        self._ended[:] = False
        return self._batch.observations(), self._poses()

    def step(self, actions: np.ndarray) -> tuple[Observations, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Try an action (N,) in each episode, as :meth:`KoopmanEnv.step` does in one.

        Raises:
            ValueError: an action is none of the ten.
            PauseRequested: who answers wants to go on another time.
        """
        batch, active = self._begun(), ~self._ended
        self._begin(self._ended)
        steps = batch.step(np.asarray(actions), active)
        self._ended = steps.terminated | steps.truncated
        if self.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP and self._ended.any():
            infos = self._begin_ended(steps)
        else:
            infos = {**self._poses(), **_told(steps, active)}
        return batch.observations(), steps.rewards, steps.terminated, steps.truncated, infos

    def render(self) -> tuple[Image, ...] | None:
        """Return a picture (480, 640, 3) of each episode in the mode ``rgb_array``, None otherwise.

        Raises:
            WorkFailedError: OpenGL does not work here.
        """
        if self.render_mode != "rgb_array":
            return None
        self._pictures = self._pictures or Pictures(self._parts.workcell)
        return tuple(self._pictures.picture(joints) for joints in self._begun().joints)

    def close_extras(self, **kwargs: Any) -> None:
        """Free what OpenGL holds, and close the oracle."""
        if self._pictures is not None:
            self._pictures.close()
            self._pictures = None
        self._parts.oracle.close()

    def _begun(self) -> Batch:
        if self._batch is None:
            raise gymnasium.error.ResetNeeded("reset() must be called before step() and render(), found it was not")
        return self._batch

    def _begin(self, which: np.ndarray) -> None:
        for index in np.flatnonzero(which):
            self._begun().begin(int(index))

    def _poses(self, which: np.ndarray | None = None) -> dict[str, Any]:
        every = np.ones(self.num_envs, dtype=bool)
        return {"pose": self._begun().poses, "_pose": every if which is None else which}

    def _begin_ended(self, steps: Steps) -> dict[str, Any]:
        """Begin the episodes that have ended; return the infos of all, with how these ended apart."""
        ended, going = self._ended.copy(), ~self._ended
        last = np.full(self.num_envs, None, dtype=object)
        for index, row in zip(np.flatnonzero(ended), self._begun().observations()[ended], strict=True):
            last[index] = row
        final = {**self._poses(ended), **_told(steps, ended)}
        self._begin(ended)
        self._ended[:] = False
        told = {**self._poses(), **_told(steps, going)}
        return {**told, "final_obs": last, "_final_obs": ended, "final_info": final, "_final_info": ended.copy()}


def action_space(parts: EnvironmentParts) -> Discrete | Box[np.float32]:
    """Return the ten actions, or, where they are continuous, a twist's numbers, each from −1 to 1.

    Of a twist longer than its balls allow the direction counts (:func:`koopdqn.tasks.actions.in_balls`).
    """
    return Box(-1.0, 1.0, (parts.twist,), np.float32) if parts.twist else Discrete(COUNT)


def observation_space(workcell: Workcell) -> Box[np.float32]:
    """Return the bounds of the agent's observations, as :func:`koopdqn.rl.network.observe` gives them.

    Positions may lie beyond the arm's reach by as much as starts lie apart, since they are told as from one start.
    """
    far = 2.0 * workcell.scene.reach
    turns = [np.pi] * 3 if workcell.task.orientation == "learned" else []
    high = np.array([far] * 3 + turns + [2.0 * far, np.pi], dtype=np.float32)
    low = np.concatenate([-high[:-2], np.zeros(2, dtype=np.float32)])
    return Box(low, high, dtype=np.float32)


def _told(steps: Steps, which: np.ndarray) -> dict[str, Any]:
    """Return the infos of steps, in Gymnasium's form: arrays, each with a mask of the episodes that it tells of."""
    infos = {
        "source": SOURCE_NAMES[steps.sources],
        "undone": steps.undone.copy(),
        "is_success": steps.terminated.copy(),
    }
    return {**infos, **{f"_{name}": which.copy() for name in infos}}


def _frames_per_second(workcell: Workcell) -> int:
    return max(1, round(1.0 / workcell.arm.step_seconds))


def _check_no_options(options: dict[str, Any] | None) -> None:
    if options:
        raise BadInputError(f"options: there are none for reset(), found {', '.join(map(str, options))}")
