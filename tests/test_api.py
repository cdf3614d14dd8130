"""The API: lazily imported, and the same training as the command line's."""

import io
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeAlias

import hydra
import numpy as np
import pytest
from small_run import SMALL, SOON

import koopdqn
from koopdqn.app import api, cli
from koopdqn.app.commands.configuration import Configuration
from koopdqn.demonstrations.csv import write_csv
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.hdf5 import write_hdf5
from koopdqn.errors import BadInputError
from koopdqn.intent.fit import Fitted
from koopdqn.resources import conf_dir

Made: TypeAlias = tuple[Configuration, Demonstrations, Fitted, api.Trained]
ODD: Any = (3, lambda question: True)


def test_importing_koopdqn_loads_neither_torch_nor_mujoco() -> None:
    code = "import sys, koopdqn; print([m for m in ('torch', 'mujoco', 'numpy', 'hydra') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_what_reads_recordings_and_settings_loads_neither_torch_nor_mujoco() -> None:
    code = (
        "import sys, koopdqn.app.commands.demonstrations; print([m for m in ('torch', 'mujoco') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("name", koopdqn.__all__)
def test_every_name_of_the_api_is_there_and_described(name: str) -> None:
    value = getattr(koopdqn, name)
    assert name == "__version__" or value.__doc__


def test_an_unknown_name_is_no_attribute() -> None:
    with pytest.raises(AttributeError, match=r"has no attribute .trian"):
        koopdqn.trian  # noqa: B018


@pytest.mark.parametrize(
    ("overrides", "words"),
    [(["task=shel"], ("task", "shelf")), (["agent.gama=1"], ("gama", "gamma")), (["agent.gamma=2"], ("gamma", "2"))],
)
def test_a_bad_config_is_told_as_on_the_command_line(overrides: list[str], words: tuple[str, ...]) -> None:
    with pytest.raises(BadInputError) as caught:
        koopdqn.load_config(*overrides)
    assert all(word in str(caught.value) for word in words)


def test_a_folder_of_own_options_must_exist() -> None:
    with pytest.raises(BadInputError, match="config_dir: must be a folder that exists, found '/nope'"):
        koopdqn.load_config(config_dir="/nope")


def test_the_folder_it_is_called_in_is_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, demonstrations: Demonstrations
) -> None:
    monkeypatch.chdir(tmp_path)
    write_hdf5(tmp_path / "demos.hdf5", demonstrations)
    with pytest.raises(BadInputError, match="demos: must name the files"):
        koopdqn.load_config("task=demonstrated")
    write_csv(tmp_path / "other.csv", demonstrations.items[:2])
    assert koopdqn.load_config("task=demonstrated", "demos=other.csv").task.name == "demonstrated"


def test_short_names_are_taken_as_on_the_command_line(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text("[{name: a, shape: sphere, center_m: [1, 1, 1], radius_m: 0.1}]")
    assert koopdqn.load_config(f"obstacles={tmp_path}/scene.yaml").task.obstacles[0].name == "a"
    with pytest.raises(BadInputError, match="goal: koopdqn train goes to the goal that was demonstrated"):
        koopdqn.load_config("goal=[0.5,0.0,0.5]")


def test_training_from_python_gives_the_networks_of_the_command_line(tmp_path: Path) -> None:
    assert cli.main(["train", "task=shelf", *SOON, f"out={tmp_path / 'run'}"]) in (0, 1)
    config = koopdqn.load_config("task=shelf", *SOON)
    demonstrations = koopdqn.generate(config)
    intent = koopdqn.fit(config, demonstrations)
    trained = koopdqn.train(config, demonstrations, intent)
    saved, _ = koopdqn.read_policy(tmp_path / "run" / "policy.safetensors", config.task)
    for name, values in saved.network.state_dict().items():
        np.testing.assert_array_equal(values.numpy(), trained.policy.network.state_dict()[name].numpy())
    environment = koopdqn.make_env(config, demonstrations, intent)
    assert environment.reset().first()
    assert environment.step(0).reward is not None


@pytest.fixture(scope="module")
def small() -> Made:
    """Config, demonstrations and intent of the shelf, and what a training too short to learn brings."""
    config = koopdqn.load_config("task=shelf", *SMALL, "train.max_steps=2000", "eval.episodes=2", "eval.dynamics=false")
    demonstrations = koopdqn.generate(config)
    intent = koopdqn.fit(config, demonstrations)
    return config, demonstrations, intent, koopdqn.train(config, demonstrations, intent)


def test_what_is_of_another_task_is_refused(small: Made) -> None:
    config, demonstrations, intent, trained = small
    knife = koopdqn.load_config("task=knife", "demo.count=2", "eval.episodes=2")
    own = koopdqn.generate(knife)
    with pytest.raises(BadInputError, match="demonstrations must be of task knife, found task shelf"):
        koopdqn.train(knife, demonstrations, intent)
    for use in (koopdqn.train, koopdqn.make_env):
        with pytest.raises(BadInputError, match="intent must be of task knife, which ends at"):
            use(knife, own, intent)
    with pytest.raises(BadInputError, match="intent must be of task knife"):
        koopdqn.intent_reward(knife, intent)
    with pytest.raises(BadInputError, match="policy must be of task knife, found task shelf"):
        koopdqn.evaluate(knife, own, koopdqn.fit(knife, own), trained)
    assert koopdqn.evaluate(config, demonstrations, intent, trained).report["task"] == "shelf"
    continuous = koopdqn.load_config("task=shelf", "actions=continuous")
    with pytest.raises(BadInputError, match="actions: must be those of the policy, table1, found continuous"):
        koopdqn.evaluate(continuous, demonstrations, intent, trained)


def test_who_answers_must_be_an_oracle_that_can(small: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    config, demonstrations, intent, _ = small
    for odd in ODD:
        for use in (koopdqn.train, koopdqn.make_env):
            with pytest.raises(BadInputError, match=r"oracle: must be a koopdqn\.oracles\.base\.Oracle, found"):
                use(config, demonstrations, intent, odd)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    terminal = koopdqn.load_config("task=shelf", "oracle=terminal", *SMALL)
    with pytest.raises(BadInputError, match="standard input must be a terminal, found a pipe or file"):
        koopdqn.make_env(terminal, demonstrations, intent)


@pytest.mark.parametrize(
    "override",
    ["intent=/nowhere/intent.npz", "run=foo", "out=foo", "trust_modules=pouring", "hydra.run.dir=x", "command=eval"],
)
def test_what_only_the_command_line_reads_is_refused(override: str) -> None:
    with pytest.raises(BadInputError, match=f"{override.partition('=')[0]}: must be left out, .* found {override}"):
        koopdqn.load_config(override)


def test_arguments_of_another_class_are_named(small: Made, tmp_path: Path) -> None:
    config, demonstrations, fitted, _ = small
    calls: dict[str, tuple[Any, ...]] = {
        "config: must be a koopdqn.app.commands.configuration.Configuration, found None": (koopdqn.open_workcell, None),
        "config: must be a .*Configuration, found 'task=shelf'": (koopdqn.generate, "task=shelf"),
        "demonstrations: must be a .*Demonstrations, found \\[3\\]": (koopdqn.fit, config, [3]),
        "config: must be a .*Configuration, found Demonstrations": (koopdqn.fit, demonstrations, config),
        "fitted: must be a koopdqn.intent.fit.Fitted or koopdqn": (
            koopdqn.intent_reward,
            config,
            fitted.model,
        ),
        "demonstrations: must be a .*Demonstrations, found Fitted": (koopdqn.train, config, fitted, demonstrations),
        "trained: must be a koopdqn.app.api.Trained, found None": (
            *(koopdqn.evaluate, config, demonstrations, fitted, None),
        ),
        "task: must be a koopdqn.tasks.task.Task, found Configuration": (koopdqn.read_policy, tmp_path, config),
        "demos: must be a path or a glob, or several, found 3": (koopdqn.read_demonstrations, 3, "shelf", "UR5"),
        "arm: must be a str or koopdqn.robot.arm.Arm, found None": (koopdqn.read_demonstrations, "a", "shelf", None),
        "declared: must be a .*ImportSettings, found {'units': 'mm'}": (
            *(koopdqn.read_demonstrations, "a", "shelf", "UR5", False, {"units": "mm"}),
        ),
    }
    for words, (function, *arguments) in calls.items():
        with pytest.raises(BadInputError, match=words):
            function(*arguments)
    odd: Any = 3
    with pytest.raises(BadInputError, match=r"config_dir: must be a str or pathlib\.Path, found 3"):
        koopdqn.load_config(config_dir=odd)


def test_a_program_that_uses_hydra_itself_keeps_its_own(tmp_path: Path) -> None:
    (tmp_path / "own.yaml").write_text("a: 1\n")
    with hydra.initialize_config_dir(str(tmp_path), version_base="1.2"):
        with ThreadPoolExecutor(4) as pool:
            seeds = list(pool.map(lambda seed: koopdqn.load_config(f"seed={seed}").inputs.seed, range(8)))
        assert seeds == list(range(8))
        assert hydra.compose("own").a == 1
        assert str(hydra.version.getbase()) == "1.2"


def test_overrides_must_be_texts() -> None:
    odd: Any = ["task=shelf"]
    with pytest.raises(BadInputError, match="an override must be a text such as 'seed=3', found \\['task=shelf'\\]"):
        koopdqn.load_config(odd)


@pytest.mark.parametrize("name", ["my dir", "a,b", "it's", "50%"])
def test_a_folder_of_own_options_may_have_any_name(name: str, tmp_path: Path) -> None:
    option = tmp_path / name / "intent" / "mine.yaml"
    option.parent.mkdir(parents=True)
    option.write_text((conf_dir() / "intent" / "pose.yaml").read_text().replace("name: pose", "name: mine"))
    assert koopdqn.load_config("intent=mine", config_dir=tmp_path / name).intent.name == "mine"
