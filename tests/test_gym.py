"""The environment as Gymnasium, Stable-Baselines3 and dm_control's viewer know it."""

import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from parts import Clerk, with_fields
from stable_baselines3.common.env_checker import check_env as check_for_stable_baselines
from test_dm import untrusting

import koopdqn.gym
from koopdqn.app import api
from koopdqn.app.commands.configuration import Configuration
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.hdf5 import write_hdf5
from koopdqn.envs import display
from koopdqn.envs.batch import EnvironmentParts
from koopdqn.envs.dm import KoopmanEnvironment
from koopdqn.envs.gym import KoopmanEnv, KoopmanVectorEnv, observation_space
from koopdqn.envs.sb3 import FourierFeatures, StableBaselinesVecEnv
from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.intent.fit import Fitted
from koopdqn.intent.reward import IntentReward
from koopdqn.oracles.scripted import ScriptedOracle
from koopdqn.rl.answers import FeedbackSettings
from koopdqn.tasks.workcell import Workcell, open_workcell

SMALL = ("demo.count=2", "intent.count=60")
LEARNING = FeedbackSettings(remember_m=0.01, remember_rad=0.05, extend=True, reach_m=0.07)
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")


@pytest.fixture
def env_parts(workcell: Workcell, reward: IntentReward) -> EnvironmentParts:
    return EnvironmentParts(workcell, reward, ScriptedOracle(workcell.task), 40, LEARNING)


@pytest.fixture
def no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in DISPLAYS:
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def made() -> Iterator[gymnasium.Env[Any, Any]]:
    environment = gymnasium.make("koopdqn/Shelf-v0", render_mode="rgb_array", overrides=SMALL)
    yield environment
    environment.close()


@pytest.mark.usefixtures("no_display")
@pytest.mark.draws
def test_both_checkers_are_silent(made: gymnasium.Env[Any, Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(made.unwrapped)
        check_for_stable_baselines(made, skip_render_check=False)


def actions_of(seed: int, steps: int, count: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(10, size=(steps, count))


def test_one_of_many_is_the_same_as_one(env_parts: EnvironmentParts) -> None:
    one, many = KoopmanEnv(env_parts), KoopmanVectorEnv(env_parts, 1)
    first, told = one.reset(seed=3)
    firsts, all_told = many.reset(seed=3)
    np.testing.assert_array_equal(first, firsts[0])
    np.testing.assert_array_equal(told["pose"], all_told["pose"][0])
    for actions in actions_of(0, 30, 1):
        observation, reward, terminated, truncated, info = one.step(actions[0])
        observations, rewards, *ends, infos = many.step(actions)
        np.testing.assert_array_equal(observation, observations[0])
        assert (reward, terminated, truncated) == (rewards[0], ends[0][0], ends[1][0])
        for name, value in info.items():
            np.testing.assert_array_equal(infos[name][0], value)
            assert infos[f"_{name}"].all()


def played(environment: KoopmanVectorEnv, seed: int) -> list[Any]:
    trace: list[Any] = [environment.reset(seed=seed)[0]]
    for actions in actions_of(1, 25, environment.num_envs):
        *numbers, infos = environment.step(actions)
        trace += [*numbers, infos["source"]]
    return trace


def test_a_seed_makes_all_as_new(env_parts: EnvironmentParts) -> None:
    """Starts, and what answers have taught: an action that was asked about is asked about again."""
    environment = KoopmanVectorEnv(env_parts, 6)
    first, other, again = played(environment, 4), played(environment, 5), played(environment, 4)
    assert "asked" in np.concatenate(first[5::5])
    for before, after in zip(first, again, strict=True):
        np.testing.assert_array_equal(before, after)
    assert not np.array_equal(first[0], other[0])


def test_wrong_actions_are_undone_and_observations_are_in_their_space(env_parts: EnvironmentParts) -> None:
    environment = KoopmanVectorEnv(env_parts, 16)
    before, _ = environment.reset(seed=0)
    seen = set()
    for actions in actions_of(2, 20, 16):
        after, rewards, _, _, infos = environment.step(actions)
        np.testing.assert_array_equal(infos["undone"], rewards < 0)
        np.testing.assert_array_equal(infos["undone"], (before == after).all(axis=1))
        assert after in environment.observation_space
        seen |= set(infos["source"])
        before = after
    assert {"rule", "trusted"} <= seen


def test_an_answer_holds_for_the_other_episodes_of_the_same_step(workcell: Workcell, reward: IntentReward) -> None:
    clerk = Clerk(lambda question: True)
    task = with_fields(workcell.task, start_half_range_m=[0.0, 0.0, 0.0])
    alike = open_workcell(task, workcell.arm)
    environment = KoopmanVectorEnv(EnvironmentParts(alike, untrusting(reward), clerk, 40, LEARNING), 5)
    environment.reset(seed=0)
    infos = environment.step(np.full(5, 4))[4]
    assert len(clerk.asked) == 1
    assert infos["source"][0] == "asked"
    assert "asked" not in infos["source"][1:]


def test_nobody_asked_means_no_reward_and_no_motion(workcell: Workcell, reward: IntentReward) -> None:
    parts = EnvironmentParts(workcell, untrusting(reward), Clerk(lambda question: None), 40)
    environment = KoopmanEnv(parts)
    first, _ = environment.reset(seed=0)
    observation, given, _, _, info = environment.step(np.int64(4))
    np.testing.assert_array_equal(first, observation)
    assert (given, info["source"], info["undone"]) == (0.0, "none", True)


def cut_after(limit: int, parts: EnvironmentParts, count: int, mode: str) -> KoopmanVectorEnv:
    short = EnvironmentParts(parts.workcell, parts.reward, parts.oracle, limit)
    return KoopmanVectorEnv(short, count, autoreset_mode=mode)


def test_the_next_step_begins_an_ended_episode(env_parts: EnvironmentParts) -> None:
    environment = cut_after(3, env_parts, 2, "NextStep")
    environment.reset(seed=0)
    cut = [environment.step(np.array([2, 2]))[3].all() for _ in range(3)]
    assert cut == [False, False, True]
    observations, rewards, terminated, truncated, infos = environment.step(np.array([4, 4]))
    assert not rewards.any()
    assert not terminated.any()
    assert not truncated.any()
    assert not infos["_source"].any()
    assert environment.step(np.array([2, 2]))[1].tolist() == [-1.0, -1.0]
    np.testing.assert_array_equal(observations[:, :3], infos["pose"][:, :3].astype(np.float32))


def test_the_same_step_begins_an_ended_episode_and_tells_how_it_ended(env_parts: EnvironmentParts) -> None:
    environment = cut_after(3, env_parts, 2, "SameStep")
    before, _ = environment.reset(seed=0)
    for _ in range(2):
        environment.step(np.array([2, 2]))
    after, rewards, _, truncated, infos = environment.step(np.array([2, 2]))
    assert environment.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert truncated.all()
    assert rewards.tolist() == [-1.0, -1.0]
    np.testing.assert_array_equal(np.stack(infos["final_obs"]), before)
    assert infos["final_info"]["source"].tolist() == ["rule", "rule"]
    assert (after != before).any(axis=1).all()


def test_stable_baselines_is_told_how_episodes_ended(env_parts: EnvironmentParts) -> None:
    environment = StableBaselinesVecEnv(cut_after(2, env_parts, 3, "SameStep"))
    environment.seed(5)
    before = environment.reset()
    environment.step(np.full(3, 2))
    after, _, done, infos = environment.step(np.full(3, 2))
    assert done.all()
    for index, info in enumerate(infos):
        np.testing.assert_array_equal(info["terminal_observation"], before[index])
        assert info["TimeLimit.truncated"]
        assert info["episode"]["r"] == -2.0
        assert info["episode"]["l"] == 2
    assert not np.array_equal(np.asarray(after), before)
    environment.seed(5)
    np.testing.assert_array_equal(environment.reset(), before)
    assert len(environment.env_method("render")) == 3
    assert len(environment.env_method("render", indices=[0, 2])) == 2
    single: Any = KoopmanEnv(env_parts)
    with pytest.raises(BadInputError, match="env: must be a vector environment"):
        StableBaselinesVecEnv(single)
    with pytest.raises(BadInputError, match="must be SameStep for Stable-Baselines3, found NextStep"):
        StableBaselinesVecEnv(cut_after(2, env_parts, 3, "NextStep"))


@pytest.mark.parametrize("along", [True, False])
def test_episodes_begin_as_in_training_where_wished(along: bool) -> None:
    """Along a demonstration and short; otherwise in the start region, whatever the agent's settings say."""
    overrides = (*SMALL, "agent.exploring_starts=1", "agent.exploring_in_region=0", "agent.exploring_steps=3")
    environment = gymnasium.make_vec("koopdqn/Shelf-v0", 12, overrides=overrides, exploring_starts=along)
    _, told = environment.reset(seed=0)
    task = koopdqn.gym.environment_parts("shelf", overrides).workcell.task
    from_middle = np.abs(told["pose"][:, :3] - task.nominal_start[:3])
    assert (from_middle > task.start_half_range_m).any() == along
    cut = [environment.step(np.full(12, 2))[3] for _ in range(3)]
    assert not np.any(cut[:2])
    np.testing.assert_array_equal(cut[2], along)


def test_features_keep_what_is_observed_and_waves_vary_as_much() -> None:
    torch.manual_seed(0)
    extractor = FourierFeatures(gymnasium.spaces.Box(-9.0, 9.0, (5,)), features=400)
    seen = torch.randn(500, 5)
    features = extractor(seen)
    assert features.shape == (500, extractor.features_dim)
    assert torch.equal(features[:, :5], seen)
    assert features[:, 5:].square().mean().item() == pytest.approx(1.0, abs=0.05)
    elsewhere = seen.clone()
    elsewhere[:, 3:] += 1.0
    assert torch.equal(extractor(elsewhere)[:, 5:], features[:, 5:])


@pytest.mark.draws
def test_pictures_show_the_arm_where_it_is(env_parts: EnvironmentParts) -> None:
    environment = KoopmanVectorEnv(env_parts, 2, render_mode="rgb_array")
    environment.reset(seed=0)
    one, two = environment.render() or ((), ())
    assert np.shape(one) == (480, 640, 3)
    assert not np.array_equal(one, two)
    environment.close()
    assert KoopmanEnv(env_parts).render() is None


def test_a_window_follows_the_arm(env_parts: EnvironmentParts, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[np.ndarray] = []
    closed: list[bool] = []

    def launch(model: Any, data: Any) -> SimpleNamespace:
        return SimpleNamespace(
            lock=nullcontext, sync=lambda: shown.append(data.qpos.copy()), close=lambda: closed.append(True)
        )

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setitem(sys.modules, "mujoco.viewer", SimpleNamespace(launch_passive=launch))
    monkeypatch.setattr(mujoco, "viewer", SimpleNamespace(launch_passive=launch), raising=False)
    monkeypatch.setattr(display, "try_window", lambda: None)
    environment = KoopmanEnv(env_parts, render_mode="human")
    _, told = environment.reset(seed=0)
    poses = [told["pose"]]
    for action in range(4, 10):
        poses.append(environment.step(np.int64(action))[4]["pose"])
    environment.close()
    index = env_parts.workcell.scene.joint_index
    np.testing.assert_allclose([env_parts.workcell.arm.forward(row[index]) for row in shown], poses, atol=1e-6)
    assert closed


@pytest.mark.usefixtures("no_display")
def test_a_window_without_a_display_is_refused(env_parts: EnvironmentParts) -> None:
    with pytest.raises(BadInputError, match="rgb_array where there is no display, found human"):
        KoopmanEnv(env_parts, render_mode="human")


def test_a_display_that_opens_no_window_is_told(env_parts: EnvironmentParts, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setitem(sys.modules, "glfw", SimpleNamespace(init=lambda: False))
    with pytest.raises(WorkFailedError, match="the window cannot be opened: this display opens none"):
        KoopmanEnv(env_parts, render_mode="human").reset()


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"render_mode": "ansi"}, "unknown render_mode 'ansi'; valid: rgb_array"),
        ({"num_envs": 0}, "num_envs: must be a whole number, 1 or above, found 0"),
        ({"num_envs": "2"}, "num_envs: must be a whole number, 1 or above, found '2'"),
        ({"num_envs": 2.5}, "num_envs: must be a whole number, 1 or above, found 2.5"),
        ({"autoreset_mode": "Disabled"}, "unknown autoreset_mode 'Disabled'; valid: NextStep, SameStep"),
    ],
)
def test_keywords_that_cannot_be_are_refused(env_parts: EnvironmentParts, keywords: dict[str, Any], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        KoopmanVectorEnv(env_parts, **{"num_envs": 2, **keywords})


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"overrides": None}, "overrides: must be a text such as 'seed=3', or several, found None"),
        ({"overrides": {"seed": 3}}, "overrides: must be a text such as 'seed=3', or several, found {'seed': 3}"),
        ({"overrides": 3}, "overrides: must be a text such as 'seed=3', or several, found 3"),
        ({"overrides": SMALL, "exploring_starts": "no"}, "exploring_starts: must be a bool, found 'no'"),
    ],
)
def test_keywords_of_another_class_are_refused(keywords: dict[str, Any], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        gymnasium.make("koopdqn/Shelf-v0", **keywords)


@pytest.mark.parametrize("several", [np.array, set, iter])
def test_overrides_may_be_any_texts(several: Callable[[list[str]], Any]) -> None:
    assert koopdqn.gym.environment_parts("shelf", several(list(SMALL))).step_limit > 0


def test_misuse_is_told(env_parts: EnvironmentParts) -> None:
    environment = KoopmanEnv(env_parts)
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
        environment.step(np.int64(4))
    with pytest.raises(BadInputError, match="options: there are none for reset"):
        environment.reset(options={"pose": 1})
    environment.reset(seed=0)
    with pytest.raises(ValueError, match="action must be from 0 to 9, found 10"):
        environment.step(np.int64(10))
    with pytest.raises(ValueError, match=r"action must be a whole number, found \[3\.7\]"):
        environment.step(3.7)
    assert environment.step(np.array([4]))[4]["source"] != "none"
    many = KoopmanVectorEnv(env_parts, 3)
    many.reset(seed=0)
    for actions in (np.zeros(4, int), np.zeros(2, int), np.zeros((3, 1), int)):
        with pytest.raises(ValueError, match=r"actions must have shape \(3,\), found"):
            many.step(actions)
    with pytest.raises(ValueError, match="action must be a whole number"):
        many.step(np.array([0.0, np.nan, 1.0]))


@pytest.mark.parametrize(
    ("chosen", "words"),
    [(lambda seen: [10] * len(seen), "from 0 to 9, found 10"), (lambda seen: None, r"shape \(4,\), found \(\)")],
)
def test_what_is_chosen_where_success_is_measured_is_checked(
    env_parts: EnvironmentParts, chosen: Any, words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        env_parts.success_rate(chosen, 4)
    assert env_parts.success_rate(lambda seen: [4] * len(seen), 4) == 0.0  # type: ignore[arg-type,return-value]


def test_where_orientation_is_learned_the_rotation_vector_is_observed() -> None:
    space = observation_space(api.open_workcell(api.load_config("task=knife")))
    assert space.shape == (8,)
    np.testing.assert_array_equal(space.high[3:6], np.float32(np.pi))


def test_the_flange_stays_within_reach(workcell: Workcell) -> None:
    joints = np.random.default_rng(0).uniform(-np.pi, np.pi, (200, 6))
    far = np.linalg.norm(workcell.arm.forward(joints)[:, :3], axis=1)
    assert far.max() < workcell.scene.reach < 1.5 * far.max()


def test_the_intent_is_fitted_once_in_a_process(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    fits: list[Demonstrations] = []
    fit = api.fit

    def counted(config: Configuration, demonstrations: Demonstrations) -> Fitted:
        fits.append(demonstrations)
        return fit(config, demonstrations)

    monkeypatch.setattr(koopdqn.gym, "_FITTED", {})
    monkeypatch.setattr(api, "fit", counted)
    for kind in (gymnasium.make, gymnasium.make_vec):
        kind("koopdqn/Shelf-v0", overrides=SMALL).close()
    assert len(fits) == 1
    shown = next(iter(koopdqn.gym._FITTED.values()))[0]
    file = tmp_path / "it's, [shown].hdf5"
    write_hdf5(file, shown)
    gymnasium.make("koopdqn/Shelf-v0", overrides=SMALL, demonstrations=file).close()
    assert [held.digest() for held, _ in koopdqn.gym._FITTED.values()] == [shown.digest()] * 2


def test_demonstrations_alone_make_an_environment(demonstrations: Demonstrations, tmp_path: Path) -> None:
    file = tmp_path / "shown.hdf5"
    write_hdf5(file, demonstrations)
    environment = gymnasium.make("koopdqn/Demonstrated-v0", demonstrations=[file])
    assert environment.reset(seed=0)[0] in environment.observation_space
    with pytest.raises(BadInputError, match="demos: must name the files"):
        gymnasium.make("koopdqn/Demonstrated-v0")


def test_questions_that_are_put_off_are_refused() -> None:
    with pytest.raises(BadInputError, match=r"oracle\.ask: must be at_once in an environment, found episode"):
        gymnasium.make("koopdqn/Shelf-v0", overrides=(*SMALL, "oracle.ask=episode"))


def test_without_gymnasium_the_extra_is_named() -> None:
    code = "import sys; sys.modules['gymnasium'] = None; import koopdqn.gym"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "pip install 'koopdqn[gym]'" in done.stderr


def test_the_viewer_of_dm_control_sees_the_arm_move(workcell: Workcell, reward: IntentReward) -> None:
    with warnings.catch_warnings(action="ignore"):
        # glfw misses a display when it is imported; the runtime needs none.
        from dm_control.viewer.runtime import Runtime

    environment = KoopmanEnvironment(EnvironmentParts(workcell, untrusting(reward), Clerk(), 50), 0)
    runtime = Runtime(environment, policy=lambda timestep: 4)
    for _ in range(6):
        runtime.tick(0.02, paused=False)
    data = environment.physics.data
    assert data.time == pytest.approx(6 * workcell.arm.step_seconds)
    joints = data.qpos[workcell.scene.joint_index]
    np.testing.assert_allclose(workcell.arm.forward(joints), environment.pose, atol=1e-6)
