"""What is right in form and odd in content ends as bad input does, in one line; so do odd surroundings."""

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from parts import Parts

from koopdqn import console
from koopdqn.app import cli
from koopdqn.artifact import Artifact, read_artifact, reading, write_artifact
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.errors import BadInputError
from koopdqn.intent.fit import Fitted
from koopdqn.intent.storage import StoredIntent, read_intent
from koopdqn.rl.dqn import arrays_of
from koopdqn.rl.network import QNetwork, size
from koopdqn.rl.policy import read_policy, write_policy
from koopdqn.tasks.shelf import ShelfTask
from koopdqn.tasks.start_frame import STILL

CHECKOUT = str(Path(cli.__file__).resolve().parent.parent.parent)


@pytest.fixture(scope="module")
def intent(
    tmp_path_factory: pytest.TempPathFactory, fitted: Fitted, parts: Parts, demonstrations: Demonstrations
) -> Path:
    path = tmp_path_factory.mktemp("odd") / "intent.npz"
    StoredIntent(fitted.model, fitted.trust, parts.intent, demonstrations.digest()).write(path, parts.task)
    return path


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory, parts: Parts) -> Path:
    path = tmp_path_factory.mktemp("odd") / "policy.safetensors"
    few = parts.agent.network.model_copy(update={"hidden": (4,), "fourier_features": 4})
    network = QNetwork(size(parts.task), few, np.random.default_rng(0))
    about = {"task": read_artifact_task(parts)}
    write_policy(path, arrays_of(network), few, STILL, about)
    return path


def read_artifact_task(parts: Parts) -> dict[str, Any]:
    from koopdqn.artifact import described

    return described(parts.task)


ODD_VALUES: st.SearchStrategy[Any] = (
    st.none() | st.booleans() | st.integers(-2, 10**12) | st.just("x") | st.just([]) | st.just({"target": "koopdqn.x"})
)


@settings(max_examples=60)
@given(data=st.data())
@pytest.mark.parametrize("kind", ["intent", "policy"])
def test_an_artifact_of_odd_content_is_read_or_refused_in_one_line(
    intent: Path, policy: Path, shelf_task: ShelfTask, data: st.DataObject, kind: str
) -> None:
    source = {"intent": intent, "policy": policy}[kind]
    readers: dict[str, Callable[[Path, ShelfTask], object]] = {"intent": read_intent, "policy": read_policy}
    read = readers[kind]
    artifact = read_artifact(source, kind)
    arrays = dict(artifact.arrays)
    about: Any = artifact.about
    if data.draw(st.booleans()):
        name = data.draw(st.sampled_from(sorted(arrays)))
        change: Callable[[np.ndarray], np.ndarray] | None = data.draw(
            st.sampled_from([None, lambda x: x[..., None], lambda x: x.ravel()[:1], lambda x: x[None, None]])
        )
        if change is None:
            del arrays[name]
        else:
            arrays[name] = np.ascontiguousarray(change(arrays[name]))
    else:
        node = about
        while True:
            name = data.draw(st.sampled_from(sorted(node)))
            if not (isinstance(node[name], dict) and node[name] and data.draw(st.booleans())):
                break
            node = node[name]
        if data.draw(st.booleans()):
            del node[name]
        else:
            node[name] = data.draw(ODD_VALUES)
    path = source.with_name(f"odd{source.suffix}")
    write_artifact(path, replace(artifact, arrays=arrays, about=about))
    text = ""
    try:
        read(path, shelf_task)
    except BadInputError as error:
        text = str(error)
    assert len(text.splitlines()) <= 1


@pytest.mark.parametrize("kind", ["intent", "policy"])
def test_an_artifact_without_one_of_its_arrays_is_refused(
    intent: Path, policy: Path, shelf_task: ShelfTask, kind: str
) -> None:
    source = {"intent": intent, "policy": policy}[kind]
    readers: dict[str, Callable[[Path, ShelfTask], object]] = {"intent": read_intent, "policy": read_policy}
    artifact = read_artifact(source, kind)
    # Of a frame that changes nothing the file may hold nothing.
    needed = [name for name in artifact.arrays if "frame" not in name]
    assert len(needed) > 3
    for name in needed:
        path = source.with_name(f"less{source.suffix}")
        arrays = {other: values for other, values in artifact.arrays.items() if other != name}
        write_artifact(path, replace(artifact, arrays=arrays))
        with pytest.raises(BadInputError, match=str(path)):
            readers[kind](path, shelf_task)


def test_a_policy_whose_settings_are_large_makes_no_large_network(policy: Path, shelf_task: ShelfTask) -> None:
    artifact = read_artifact(policy, "policy")
    artifact.about["network"]["hidden"] = [10**9, 10**9]
    path = policy.with_name("large.safetensors")
    write_artifact(path, artifact)
    with pytest.raises(BadInputError, match="must hold the arrays of its own settings"):
        read_policy(path, shelf_task)


def test_metadata_that_is_no_object_is_refused(tmp_path: Path) -> None:
    odd: tuple[Any, ...] = ([], "x", 3, None)
    for about in odd:
        write_artifact(tmp_path / "x.npz", Artifact("intent", {"a": np.zeros(1)}, about))
        with pytest.raises(BadInputError, match="about must be an object"):
            read_artifact(tmp_path / "x.npz", "intent")


def test_what_cannot_be_read_is_called_so() -> None:
    with (
        pytest.raises(BadInputError, match=r"policy x must be readable, the system says: Permission denied"),
        reading("policy x"),
    ):
        raise PermissionError(13, "Permission denied")


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    console.err.cache_clear()
    console.out.cache_clear()


@pytest.mark.usefixtures("elsewhere")
@pytest.mark.parametrize("override", ["robot.d6=1e308", "robot.a2=-1e308", "robot.d1=-11"])
def test_lengths_of_no_arm_are_refused(capsys: pytest.CaptureFixture[str], override: str) -> None:
    assert cli.main(["demo", override, "demo.count=1"]) == 2
    assert f"robot: {override[6:8]}: must be within 10 m, found" in capsys.readouterr().err


@pytest.mark.usefixtures("elsewhere")
def test_a_sweep_that_fails_says_so_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["demo", "-m", "demo.count=0,-1", "out=swept"]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if "HYDRA" not in line]
    assert lines == ["koopdqn: error: demo.count: must be greater than or equal to 1, found 0"]


@pytest.mark.usefixtures("elsewhere")
def test_hidden_files_of_a_new_folder_lead_nowhere(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "config.yaml").write_text("mine")
    for name in ("a", "b", "c"):
        Path(name).mkdir()
    Path("a/.hydra").touch()
    Path("b/.hydra").symlink_to(precious)
    Path("c/.hydra").mkdir()
    Path("c/.hydra/config.yaml").symlink_to(precious / "config.yaml")
    for name, message in (("a", "whose .hydra is no folder"), ("b", "whose .hydra is no folder"), ("c", "a link")):
        assert cli.main(["demo", "demo.count=1", f"out={name}"]) == 2
        assert message in capsys.readouterr().err
    assert (precious / "config.yaml").read_text() == "mine"
    assert len(list(precious.iterdir())) == 1


def koopdqn(*arguments: str, redirected: str = "", **environment: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        ["bash", "-c", f'exec "$@" {redirected}', "bash", sys.executable, "-m", "koopdqn", *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": CHECKOUT, **environment},
        check=False,
    )


@pytest.mark.usefixtures("elsewhere")
def test_closed_streams_end_nothing_but_what_needs_them() -> None:
    assert koopdqn("--version", redirected=">&-").returncode == 0
    assert koopdqn("--version", redirected=">&- 2>&- <&-").returncode == 0
    ended = koopdqn("demo", "--json", redirected=">&-")
    assert (ended.returncode, ended.stderr) == (
        2,
        "koopdqn: error: --json: standard output must be open, found it closed\n",
    )
    assert not Path("runs").exists()


def test_pictures_do_not_depend_on_the_backend_of_the_surroundings() -> None:
    code = "import koopdqn.plots.style, matplotlib; print(matplotlib.get_backend())"
    environment = {**os.environ, "PYTHONPATH": CHECKOUT, "MPLBACKEND": "garbage"}
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert (ended.returncode, ended.stdout.strip().lower()) == (0, "agg")
