"""The environment of many episodes at once, and the features of its observations, as Stable-Baselines3 knows them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from koopdqn.errors import BadInputError
from koopdqn.settings import shown


class StableBaselinesVecEnv(VecEnv):
    """Gymnasium's vector environment for a learner of Stable-Baselines3, which would step one at a time otherwise.

    ``StableBaselinesVecEnv(gymnasium.make_vec("koopdqn/Shelf-v0", 64, autoreset_mode="SameStep"))``.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        """Wrap an environment.

        Raises:
            BadInputError: it is no vector environment, or an episode that has ended does not begin anew with the same
                step, as this library needs.
        """
        if not isinstance(env, VectorEnv):
            raise BadInputError(f"env: must be a vector environment, as of gymnasium.make_vec, found {shown(env)}")
        mode = env.metadata["autoreset_mode"]
        if mode is not AutoresetMode.SAME_STEP:
            raise BadInputError(f"autoreset_mode: must be SameStep for Stable-Baselines3, found {mode.value}")
        self._env = env
        self._actions = np.zeros(env.action_space.shape or env.num_envs, dtype=env.single_action_space.dtype)
        self._returns, self._lengths = np.zeros(env.num_envs), np.zeros(env.num_envs, dtype=np.int64)
        self.render_mode = env.render_mode
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> np.ndarray:
        """Begin all episodes anew."""
        observations, _ = self._env.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._returns[:], self._lengths[:] = 0.0, 0
        return np.asarray(observations)

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions (N,) of the next step."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Try them; ``infos`` tell of each episode that has ended what this library's ``Monitor`` would."""
        observations, rewards, terminated, truncated, told = self._env.step(self._actions)
        self._returns += rewards
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for index in np.flatnonzero(terminated | truncated):
            infos[index] = {
                "terminal_observation": told["final_obs"][index],
                "TimeLimit.truncated": bool(truncated[index]),
                "is_success": bool(terminated[index]),
                "episode": {"r": float(self._returns[index]), "l": int(self._lengths[index]), "t": 0.0},
            }
            self._returns[index], self._lengths[index] = 0.0, 0
        return observations, rewards.astype(np.float32), terminated | truncated, infos

    def close(self) -> None:
        """Close the environment."""
        self._env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return a picture of each episode."""
        return [np.asarray(picture) for picture in self._env.render() or ()]

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the environment, once an episode."""
        return [getattr(self._env, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the environment, which all episodes share."""
        setattr(self._env, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of the environment, once for all episodes, and return its result once an episode."""
        found = getattr(self._env, method_name)(*method_args, **method_kwargs)
        return [found] * len(list(self._get_indices(indices)))

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Return False for each episode: they are in no wrapper of this library's."""
        return [False] * len(list(self._get_indices(indices)))


class FourierFeatures(BaseFeaturesExtractor):
    """Normalised observations, and random Fourier features of them (Rahimi & Recht 2007), as koopdqn's own network has.

    The right action changes every few millimetres, which a small network on the observations alone is slow to follow.
    ``policy_kwargs={"features_extractor_class": FourierFeatures}``. The frequencies are random and not learned.
    """

    frequencies: torch.Tensor
    phases: torch.Tensor

    def __init__(self, space: Box, features: int = 256, length_scale: float = 1.0) -> None:
        """Draw ``features`` waves of a length scale in standard deviations of the observations."""
        seen = int(np.prod(space.shape))
        super().__init__(space, seen + features)
        # The distances to the goal follow from the rest.
        self._waved = seen - 2
        self.register_buffer("frequencies", torch.randn(self._waved, features) / length_scale)
        self.register_buffer("phases", 2.0 * torch.pi * torch.rand(features))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Return the features (N, observed + features) of normalised observations (N, observed)."""
        waves = torch.cos(observations[:, : self._waved] @ self.frequencies + self.phases)
        return torch.cat([observations, 2.0**0.5 * waves], dim=1)
