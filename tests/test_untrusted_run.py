"""A run folder is data: whatever a stranger wrote into it, nothing of it is executed and nothing outside is touched."""

import json
import os
import pickle
import shutil
import sys
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from demos_file import unsealed
from hypothesis import given, settings
from hypothesis import strategies as st
from small_run import SMALL, SOON

import koopdqn
from koopdqn import console
from koopdqn.app import cli
from koopdqn.app.commands.configuration import Configuration, Inputs
from koopdqn.app.hydra.compose import composed
from koopdqn.app.hydra.overrides import prepare
from koopdqn.app.hydra.record import GROUPS, PATH_NAMES, SECTIONS, VALUES
from koopdqn.artifact import Artifact, read_artifact, write_artifact
from koopdqn.errors import BadInputError
from koopdqn.run_folder import RECORD
from koopdqn.settings import Settings, plain
from koopdqn.untrusted import trusting


class Touch:
    """What pickle executes when it reads this."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[str, str]]:
        return open, (str(self.path), "w")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made") / "run"
    assert cli.main(["train", *SOON, f"out={folder}", "--json"]) == 0
    return folder


@pytest.fixture
def run(made: Path, tmp_path: Path) -> Path:
    """A copy of a finished run in a place where nobody else looks."""
    return Path(shutil.copytree(made, tmp_path / "given" / "run"))


@pytest.fixture
def victim(tmp_path: Path) -> Path:
    """A file of the user's, outside the run folder."""
    path = tmp_path / "home" / "precious.txt"
    path.parent.mkdir()
    path.write_text("precious, and the last line is open")
    return path


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    console.err.cache_clear()
    console.out.cache_clear()
    yield
    console.err.cache_clear()
    console.out.cache_clear()


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Return the one line with which a command refuses its input with status 2."""
    capsys.readouterr()
    assert cli.main(arguments) == 2
    streams = capsys.readouterr()
    assert streams.out == ""
    [line] = streams.err.splitlines()
    assert "internal error" not in line
    return line.removeprefix("koopdqn: error: ")


def record(run: Path, *lines: str) -> None:
    """Add overrides to those that a run folder says it was begun with."""
    given = [*SMALL, "command=train", *lines]
    (run / RECORD).write_text("".join(f"- {json.dumps(line)}\n" for line in given))


ATTACKS = [
    "+hydra.callbacks.x={_target_: numpy.load, file: PICKLE, allow_pickle: true}",
    "+hydra.callbacks.x={_target_: builtins.open, file: VICTIM, mode: w}",
    "hydra.run.dir=OUTSIDE",
    "hydra.output_subdir=OUTSIDE",
    "hydra/launcher=joblib",
    "hydra.searchpath=[OUTSIDE]",
    "+hydra.job_logging.handlers.x={class: logging.FileHandler, filename: VICTIM, mode: w}",
    "--config-dir=OUTSIDE",
    "-cd=OUTSIDE",
    "task.target=my_lab.Task",
    "+task._target_=builtins.open",
    "intent.observables={target: my_lab.Powers}",
    "task.target=${task.name}",
    "task.name=${oc.env:HOME}",
    "task.name=${hydra:runtime.cwd}",
    "task.name=${new_folder:OUTSIDE}",
    "task.name=${free_folder:OUTSIDE}",
    "task.name=${hydra.runtime.cwd}",
    "task.name='${task.${oc.env:HOME}}'",
    "task.name=../../escaped",
    "task=../../../given/evil",
    "task@robot=shelf",
    "+task/x=shelf",
    "seed=0,1",
    "robot.asset=/etc/passwd",
    "robot.asset=../conf/config.yaml",
    "task.obstacles=[{name:a,shape:mesh,center_m:[0.9,0.9,1.5],file:VICTIM}]",
]
TRAIN_ONLY = [
    "oracle={target: my_lab.Oracle, name: x}",
    "demos=VICTIM",
    "demos=[VICTIM]",
    "intent_file=VICTIM",
    "oracle=file oracle.questions=VICTIM oracle.answers=VICTIM",
    "oracle={target: koopdqn.oracles.file.FileOracleSettings, name: x, questions: VICTIM, answers: VICTIM}",
    "oracle=replay oracle.journal=VICTIM",
    "+feedback.x.questions=VICTIM",
    "oracle=replay oracle.journal=../home/precious.txt",
    "oracle=replay oracle.journal=~/x",
    "oracle=replay oracle.journal=${oc.env:HOME}",
]


@pytest.mark.parametrize(
    ("command", "attack"),
    [(command, attack) for command in ("eval", "train") for attack in ATTACKS]
    + [("train", attack) for attack in TRAIN_ONLY],
)
def test_a_record_sets_koopdqns_own_keys_alone(
    run: Path, victim: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, attack: str
) -> None:
    bomb = victim.with_suffix(".pkl")
    bomb.write_bytes(pickle.dumps(Touch(tmp_path / "home" / "executed")))
    (tmp_path / "work" / "my_lab.py").write_text(f"open({str(tmp_path / 'home' / 'executed')!r}, 'w')\n")
    named = attack.replace("VICTIM", str(victim)).replace("PICKLE", str(bomb))
    named = named.replace("OUTSIDE", str(tmp_path / "home" / "new"))
    record(run, *(named.split(" ") if attack.count("=") > 1 and " oracle." in attack else [named]))
    for name in ("demos.hdf5", "intent.npz"):
        if attack.startswith(name.partition(".")[0]):
            (run / name).unlink()
    before = contents(tmp_path)
    refused(capsys, command, f"run={run}")
    assert contents(tmp_path) == before
    assert not (tmp_path / "home" / "new").exists()
    assert not list(tmp_path.rglob("escaped"))


@pytest.mark.parametrize(
    "text",
    [
        "- &a [x]\n- *a\n",
        "a: &a [x,x,x]\nb: &b [*a,*a,*a]\n",
        "- !!python/object/apply:os.system [ls]\n",
        "- " + "[" * 50_000,
        "- seed=" + "[" * 5_000 + "]" * 5_000,
        "- seed=0\n" * 2_000,
    ],
    ids=["alias", "bomb", "object", "deep", "deep value", "long"],
)
def test_a_record_that_is_no_plain_list_is_refused(run: Path, capsys: pytest.CaptureFixture[str], text: str) -> None:
    (run / RECORD).write_text(text)
    assert str(RECORD) in refused(capsys, "eval", f"run={run}")


@settings(max_examples=60)
@given(
    text=st.builds(
        "{}{}{}={}".format,
        st.sampled_from(["", "+", "++", "~"]),
        st.sampled_from([*GROUPS, *SECTIONS, *VALUES, "hydra", "hydra/launcher"]),
        st.sampled_from(["", ".x", ".name", "@robot", "/x"]),
        st.text(max_size=20) | st.sampled_from(["shelf", "0", "null", "x"]),
    )
    | st.text("{}[]:,=$+~@./_ -hydratskue'\"", max_size=40)
)
def test_whatever_a_record_holds_no_option_and_no_foreign_key_comes_out(
    tmp_path_factory: pytest.TempPathFactory, text: str
) -> None:
    folder = tmp_path_factory.mktemp("run")
    (folder / RECORD).parent.mkdir()
    (folder / RECORD).write_text(f"- {json.dumps(text)}\n")
    try:
        overrides = prepare("eval", [f"run={folder}"]).overrides
    except BadInputError:
        return
    for override in overrides:
        assert override.lstrip("+~").partition("=")[0].partition(".")[0] in (*GROUPS, *SECTIONS, *VALUES)


def test_the_keys_that_a_record_may_hold_are_those_of_the_config() -> None:
    config = plain(composed([]))
    assert set(config) == {*(group for group in GROUPS if group != "preset"), *SECTIONS, *VALUES}
    # The kind of actions is a group's option and a plain value at once.
    assert set(Inputs.model_fields) == {*VALUES, "actions"}
    assert Configuration.load(composed([]))


def test_every_setting_that_is_a_path_is_known_as_one() -> None:
    def subclasses(cls: type[Settings]) -> Iterator[type[Settings]]:
        for each in cls.__subclasses__():
            yield each
            yield from subclasses(each)

    for name in ("file", "replay", "terminal"):
        __import__(f"koopdqn.oracles.{name}")
    found = {
        name
        for cls in subclasses(Settings)
        if cls.__module__.startswith("koopdqn.")
        for name, field in cls.model_fields.items()
        if "Path" in str(field.annotation) or name in ("demos", "runs")
    }
    # An obstacle's file is read before there are fields.
    assert found | {"file"} == set(PATH_NAMES)


def test_a_module_named_on_the_command_line_is_trusted(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "lab.py").write_text(
        "from koopdqn.tasks.shelf import ShelfTask\nclass Mine(ShelfTask):\n    extra: int = 3\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    mine = tmp_path / "mine"
    small = ["train.max_steps=600", *SMALL]
    assert cli.main(["train", *small, "task.target=lab.Mine", "+task.extra=4", f"out={mine}", "--json"]) == 1
    evaluation = ["eval", f"run={mine}", "eval.episodes=2", "eval.dynamics=false", "eval.baselines=false"]
    line = refused(capsys, *evaluation)
    assert line.endswith(
        "must name a class of koopdqn, found 'lab.Mine'; if you trust that module, add trust_modules=lab, or from"
        " Python read it within koopdqn.untrusted.trusting(['lab'])"
    )
    assert cli.main([*evaluation, "trust_modules=json"]) == 2
    assert "must name modules that can be found, found none called labb" in refused(
        capsys, *evaluation, "trust_modules=[lab,labb]"
    )
    assert cli.main([*evaluation, "trust_modules=[json,lab]", "--json"]) == 0
    task, policy = (
        koopdqn.load_config(*SMALL, "task.target=lab.Mine", "+task.extra=4").task,
        mine / "policy.safetensors",
    )
    with pytest.raises(BadInputError, match="modules: must be a list of dotted names, found 'lab'"), trusting("lab"):
        pass
    with trusting(["lab"]):
        assert koopdqn.read_policy(policy, task)[0].task == task


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("raise RuntimeError('boom')", "found lab.tasks, whose package raises RuntimeError: boom"),
        ("import absent", "found lab.tasks, whose package raises ModuleNotFoundError: No module named 'absent'"),
        ("", "found none called lab.tasks; the folder it lies in must be on PYTHONPATH"),
    ],
)
def test_a_trusted_module_that_cannot_be_found_is_told_with_the_reason(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], code: str, said: str
) -> None:
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "__init__.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "lab", raising=False)
    assert refused(capsys, "eval", f"run={run}", "trust_modules=lab.tasks").endswith(said)


def test_what_a_user_gives_again_need_not_lie_in_the_run(run: Path, victim: Path) -> None:
    record(run, "oracle=replay", f"oracle.journal={victim}")
    found = prepare("train", [f"run={run}", f"journal={victim}"]).overrides
    assert [item for item in found if item.startswith("oracle")] == ["oracle=replay", f"oracle.journal={victim}"]


@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
def test_an_artifact_names_no_class_but_koopdqns_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    (tmp_path / "evil_lab.py").write_text("raise SystemExit('imported')\n")
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / f"x{suffix}"
    for about in ({"intent": {"target": "evil_lab.X"}}, {"list": [{"a": {"target": "os.system"}}]}, {"target": 3}):
        write_artifact(path, Artifact("intent", {"a": np.zeros(2)}, about))
        with pytest.raises(BadInputError, match="must name a class of koopdqn, found"):
            read_artifact(path, "intent")
    with trusting(["os"]):
        write_artifact(path, Artifact("intent", {"a": np.zeros(2)}, {"x": {"target": "os.system"}}))
        assert read_artifact(path, "intent").about["x"] == {"target": "os.system"}


def _policy_of_another_module(run: Path, victim: Path) -> None:
    artifact = read_artifact(run / "policy.safetensors", "policy")
    task = {**artifact.about["task"], "target": "evil_lab.Task"}
    write_artifact(run / "policy.safetensors", replace(artifact, about={**artifact.about, "task": task}))


def _intent_bomb(run: Path, victim: Path) -> None:
    with zipfile.ZipFile(run / "intent.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("matrix.npy", bytes(2**26))


def _intent_without_arrays(run: Path, victim: Path) -> None:
    artifact = read_artifact(run / "intent.npz", "intent")
    write_artifact(run / "intent.npz", replace(artifact, arrays={"matrix": np.zeros((2, 2))}))


def _demonstrations_elsewhere(run: Path, victim: Path) -> None:
    with h5py.File(victim.with_suffix(".hdf5"), "w") as file:
        file["x"] = np.zeros((5, 3))
    with h5py.File(run / "demos.hdf5", "r+") as file:
        del file["data/demo_0/obs/eef_pos"]
        file["data/demo_0/obs/eef_pos"] = h5py.ExternalLink(str(victim.with_suffix(".hdf5")), "/x")
    unsealed(run / "demos.hdf5")


def _deep_report(run: Path, victim: Path) -> None:
    (run / "train.json").write_text("[" * 100_000)


def _long_report(run: Path, victim: Path) -> None:
    (run / "train.json").write_text(json.dumps({"step_limit": 10**15}))


def _linked_journal(run: Path, victim: Path) -> None:
    (run / "feedback.jsonl").unlink()
    (run / "feedback.jsonl").symlink_to(victim)


def _linked_folder(run: Path, victim: Path) -> None:
    shutil.rmtree(run / "checkpoints")
    (run / "checkpoints").symlink_to(victim.parent)


def _pipe(run: Path, victim: Path) -> None:
    (run / "train.json").unlink()
    os.mkfifo(run / "train.json")


@pytest.mark.parametrize(
    "attack",
    [
        _policy_of_another_module,
        _intent_bomb,
        _intent_without_arrays,
        _demonstrations_elsewhere,
        _deep_report,
        _long_report,
        _linked_journal,
        _linked_folder,
        _pipe,
    ],
)
def test_a_folder_built_to_attack_ends_in_one_line_and_touches_nothing(
    run: Path,
    victim: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    attack: Callable[[Path, Path], None],
) -> None:
    (tmp_path / "work" / "evil_lab.py").write_text(f"open({str(tmp_path / 'home' / 'executed')!r}, 'w')\n")
    attack(run, victim)
    kept = {folder: contents(tmp_path / folder) for folder in ("home", "given")}
    for arguments in (["eval", f"run={run}", "out=measured"], ["train", f"run={run}"]):
        if arguments[0] == "train" and attack in (_policy_of_another_module, _deep_report, _long_report):
            continue  # training reads neither
        capsys.readouterr()
        assert cli.main(arguments) == 2
        streams = capsys.readouterr()
        assert streams.out == ""
        assert [line for line in streams.err.splitlines() if "koopdqn: error: " in line] == streams.err.splitlines()
        assert "internal error" not in streams.err
    assert {folder: contents(tmp_path / folder) for folder in ("home", "given")} == kept


@pytest.mark.parametrize("key", ["path", "file"])
def test_an_artifact_names_no_file(run: Path, victim: Path, capsys: pytest.CaptureFixture[str], key: str) -> None:
    found = read_artifact(run / "policy.safetensors", "policy")
    about = {**found.about, "task": {**found.about["task"], "obstacles": [{"name": "a", key: str(victim)}]}}
    write_artifact(run / "policy.safetensors", replace(found, about=about))
    assert f"task.obstacles[0].{key} must name no file" in refused(capsys, "eval", f"run={run}")


def test_a_record_names_no_arm_even_within_the_folder(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run / "arm.xml").write_text("<mujoco/>")
    record(run, "robot=mjcf", f"robot.path={run}/arm.xml", "robot.site=tool")
    assert "robot.path is never taken from a run folder" in refused(capsys, "eval", f"run={run}")


def test_whether_a_film_is_wanted_is_no_path(run: Path) -> None:
    record(run, "eval.video=true")
    assert "eval.video=True" in " ".join(prepare("eval", [f"run={run}"]).overrides).replace("true", "True")
