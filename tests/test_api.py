"""The API: lazily imported, and the same training as the command line's."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_run import SMALL

import koopdqn
from koopdqn.app import cli
from koopdqn.demonstrations.csv import write_csv
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.hdf5 import write_hdf5
from koopdqn.errors import BadInputError
from koopdqn.resources import conf_dir


def test_importing_koopdqn_loads_neither_torch_nor_mujoco() -> None:
    code = "import sys, koopdqn; print([m for m in ('torch', 'mujoco', 'numpy', 'hydra') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_what_reads_recordings_and_settings_loads_neither_torch_nor_mujoco() -> None:
    code = "import sys, koopdqn.app.commands.importing; print([m for m in ('torch', 'mujoco') if m in sys.modules])"
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
    assert cli.main(["train", "task=shelf", *SMALL, f"out={tmp_path / 'run'}"]) in (0, 1)
    config = koopdqn.load_config("task=shelf", *SMALL)
    demonstrations = koopdqn.generate(config)
    intent = koopdqn.fit(config, demonstrations)
    trained = koopdqn.train(config, demonstrations, intent)
    saved, _ = koopdqn.read_policy(tmp_path / "run" / "policy.safetensors", config.task)
    for name, values in saved.network.state_dict().items():
        np.testing.assert_array_equal(values.numpy(), trained.policy.network.state_dict()[name].numpy())
    environment = koopdqn.make_env(config, demonstrations, intent)
    assert environment.reset().first()
    assert environment.step(0).reward is not None


@pytest.mark.parametrize("name", ["my dir", "a,b", "it's", "50%"])
def test_a_folder_of_own_options_may_have_any_name(name: str, tmp_path: Path) -> None:
    option = tmp_path / name / "intent" / "mine.yaml"
    option.parent.mkdir(parents=True)
    option.write_text((conf_dir() / "intent" / "pose.yaml").read_text().replace("name: pose", "name: mine"))
    assert koopdqn.load_config("intent=mine", config_dir=tmp_path / name).intent.name == "mine"
