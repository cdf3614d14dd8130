"""Bad input, command by command: one line that names the quantity and the rule, exit status 2, nothing lost."""

import errno
import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from demos_file import unsealed
from omegaconf import OmegaConf
from small_run import SMALL, SOON

from koopdqn import console
from koopdqn.app import cli
from koopdqn.app.hydra.folder import register_resolver
from koopdqn.app.hydra.overrides import prepare
from koopdqn.demonstrations.hdf5 import read_hdf5, write_hdf5
from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.files import DivergedError, atomic_path, canonical_json, write_json
from koopdqn.rl import settings as agent_settings
from koopdqn.robot import prepare_rendering

STAGE = re.compile(r"[A-Z][a-z ]+( \.\.\.|: done in .*)")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with demonstrations of two seeds, an intent and a finished run, all of the small task."""
    folder = tmp_path_factory.mktemp("made")
    assert cli.main(["train", *SOON, f"out={folder}/run", "--json"]) == 0
    assert cli.main(["demo", *SMALL, f"out={folder}/other", "seed=1", "--json"]) == 0
    return folder


@pytest.fixture
def run_copy(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made / "run", tmp_path / "run"))


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    console.err.cache_clear()
    console.out.cache_clear()


def refused(capsys: pytest.CaptureFixture[str], *arguments: str, status: int = 2) -> str:
    """Return the one line of error that a command ends with; stages announced before it are left out."""
    capsys.readouterr()
    assert cli.main(arguments) == status
    streams = capsys.readouterr()
    assert streams.out == ""
    [line] = [line for line in streams.err.splitlines() if not STAGE.fullmatch(line)]
    return line.removeprefix("koopdqn: error: ")


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("seed=", "seed: must be a whole number, found ''"),
        ("seed=-1", "seed: must be greater than or equal to 0, found -1"),
        ("seed=1.5", "seed: must be a whole number, found 1.5"),
        ("seed=null", "seed: must be a whole number, found None"),
        ("seed=true", "seed: must be a whole number, found True"),
        ("demo=null", "demo: must be a group of keys, found None"),
        ("demo.count=0", "demo.count: must be greater than or equal to 1, found 0"),
        ("demo.speed_m_s=nan", "demo.speed_m_s: must be a finite number, found nan"),
        ("demo.speed_m_s=1e-300", "demo.speed_m_s: must be greater than or equal to 0.001, found 1e-300"),
        ("demo.sample_seconds=1e-9", "demo.sample_seconds: must be greater than or equal to 0.001, found 1e-09"),
        ("train.check_starts=5", "train.check_starts: must be greater than or equal to 20, found 5"),
        ("train.extend=inf", "train.extend: must be a finite number, found inf"),
        ("train.stop=never", "train.stop: must be 'learned' or 'limit', found 'never'"),
        ("train.threads=100000", "train.threads: must be less than or equal to 256, found 100000"),
        ("agent.device=gpu", "agent.device: must be 'cpu' or 'cuda', found 'gpu'"),
        ("train.step_limit_factor=1e300", "train.step_limit_factor: must be less than or equal to 1000"),
        ("agent.gamma=1", "agent.gamma: must be less than 1, found 1"),
        ("agent.network.hidden=[]", "agent.network.hidden: must have at least 1 item, found ()"),
        ("agent.network.length_scale_m=1e-300", "agent.network.length_scale_m: must be greater than or equal to"),
        ("agent.batch=1e3", "agent.batch: must be a whole number, found 1000.0"),
        ("agent.double=1", "agent.double: must be true or false, found 1"),
        ("agent.learning_rate=1e30", "agent.learning_rate: must be less than or equal to 1, found 1e+30"),
        ("agent.exploring_spread_m=100", "agent.exploring_spread_m: must be less than or equal to 0.5, found 100"),
        ("agent.exploring_steps=100000000000000000000", "agent.exploring_steps: must be less than or equal to"),
        ("eval.episodes=1000000000", "eval.episodes: must be less than or equal to 100000, found 1000000000"),
        ("eval.time_scale=1e300", "eval.time_scale: must be less than or equal to 1000, found 1e+300"),
        ("task.step_m=0.002", "step_m must be over position_tolerance_m"),
        ("task.step_m=0.003", "step_m must be over position_tolerance_m"),
        ("task.waypoints=[[1,2,3]]", "task.waypoints: must have at least 2 items"),
        ("task.waypoints=[[5,5,5],[6,6,6]]", "the start at [5.0, 5.0, 5.0] m must be reachable without collision"),
        ("task.name=../x", "task.name: must be a name that a folder can have"),
        ("task.target=os.system", "os has no class 'system'; valid: PathLike, stat_result"),
        ("task.target=nowhere.Task", "No module named 'nowhere'); the folder it lies in must be on PYTHONPATH"),
        (
            "intent=fourier intent.observables.target=koopdqn.intent.observables.Nope",
            "has no class 'Nope'; valid: Affine",
        ),
        ("robot.asset=ur5", "unknown asset 'ur5'; valid: ur5/"),
        ("robot.asset=ur5/README.md", "the scene of task shelf must compile in MuJoCo, which says: could not find"),
        ("robot.flange_site=hand", "unknown site of ur5/ur5.xml 'hand'; valid: attachment_site"),
        ("robot.joint_names=[a,b,c,d,e,f]", "unknown joint of ur5/ur5.xml 'a'; valid: elbow_joint"),
        ("program.start=[nan,0,0,0,0,0]", "program.start: must be nominal, 6 joint angles [rad], a pose of 7 numbers"),
        ("program.start={joint:[1]}", "or {joints: […]}, found {'joint': [1]}"),
        ("program.formats=[]", "program.formats: must be a list of one or more of urscript, ros_yaml"),
        ("eval.goal={x:1}", "eval.goal: must be a list of 3 numbers, found {'x': 1}"),
        ("oracle=crowd", "unknown option of oracle 'crowd'; valid: "),
        ("out=~nobody_of_that_name/x", "must name a home folder, found '~nobody_of_that_name/x'"),
        ("out=/dev/null", "out: must name a folder that can be written, found '/dev/null'"),
        ("demos=some.hdf5", "demos: must be left out, as koopdqn demo does not take it, found 'some.hdf5'; taken by: "),
        ("task=demonstrated", "found one that is made from demonstrations; valid: both_sides, knife, shelf"),
        ("person=via person.via_points=0", "person.via_points: must be greater than or equal to 1, found 0"),
        (
            "robot.task_scale=1.4 task.variation_m=0.04",
            "robot.task_scale: must leave every length of task shelf within its bounds, found 1.4 (variation_m: ",
        ),
    ],
)
def test_a_bad_setting_is_named_with_its_rule(capsys: pytest.CaptureFixture[str], override: str, expected: str) -> None:
    assert expected in refused(capsys, "demo", *override.split())
    assert not list(Path().rglob("demos.hdf5"))


@pytest.mark.parametrize(
    "override",
    [
        "agent.network.hidden=[10000000,10000000]",
        "agent.network.fourier_features=1000000000000",
        "agent.batch=1000000000000000000000",
        "agent.replay=1000000000000",
        "agent.episodes_at_once=1000000000000",
    ],
)
def test_what_cannot_fit_into_memory_is_refused_before_any_work(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, override: str
) -> None:
    monkeypatch.setattr(agent_settings, "physical_memory", lambda: 2**34)
    line = refused(capsys, "train", override)
    assert line.startswith("agent.")
    assert "must fit into this machine's memory of 16.0 GiB, found a need of" in line


def test_an_error_of_memory_during_work_is_no_fault_of_the_program(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for error in (MemoryError("Unable to allocate 3 GiB"), RuntimeError("DefaultCPUAllocator: can't allocate memory")):

        def fail(*_: object, error: Exception = error) -> None:
            raise error

        monkeypatch.setattr("koopdqn.app.commands.pipeline.open_scene", fail)
        assert "this machine's memory does not suffice" in refused(capsys, "demo", status=1)


def test_a_path_that_the_arm_cannot_follow_fails_at_once_and_says_where(capsys: pytest.CaptureFixture[str]) -> None:
    through_the_side_wall = "task.waypoints=[[0.53,-0.2,0.42],[0.59,0.1,0.47]]"
    line = refused(capsys, "demo", through_the_side_wall, status=1)
    assert line.startswith("task shelf: the arm must be able to follow the demonstrator, found at [0.5")
    assert "collision: shelf_right" in line


def test_a_region_out_of_reach_fails_and_says_why(capsys: pytest.CaptureFixture[str]) -> None:
    assert "unreachable" in refused(capsys, "demo", *SMALL, "task.start_half_range_m=[10,10,10]", status=1)


def damaged(made: Path, tmp_path: Path, damage: Callable[[h5py.File], None]) -> Path:
    path = tmp_path / "damaged.hdf5"
    shutil.copy(made / "run" / "demos.hdf5", path)
    with h5py.File(path, "r+") as file:
        damage(file)
    unsealed(path)
    return path


def _attribute(name: str, value: object) -> Callable[[h5py.File], None]:
    def damage(file: h5py.File) -> None:
        file["data"].attrs[name] = value

    return damage


def _first_positions(change: Callable[[np.ndarray], None]) -> Callable[[h5py.File], None]:
    def damage(file: h5py.File) -> None:
        positions = file["data/demo_0/obs/eef_pos"][...]
        change(positions)
        file["data/demo_0/obs/eef_pos"][...] = positions

    return damage


def _put(row: int, value: float) -> Callable[[np.ndarray], None]:
    def change(positions: np.ndarray) -> None:
        positions[row] = value

    return change


def _scale(positions: np.ndarray) -> None:
    positions *= 1000.0


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (_attribute("frame", "world"), "frame must be UR Base, flange (tool0), found world"),
        (_attribute("units", "mm, s, deg"), "units must be m, s, rad, found mm, s, deg"),
        (_attribute("env_args", "[]"), "its env_args a JSON object that holds env_name, found '[]'"),
        (_attribute("env_args", "{}"), "its env_args a JSON object that holds env_name, found '{}'"),
        (_attribute("env_args", '{"env_name": "knife"}'), "must be of task shelf, found task knife"),
        (_first_positions(_put(3, np.nan)), "demo_0: poses and times must be finite"),
        (_first_positions(_put(3, 2.0)), "demonstration 0 must stay within the arm's reach, found ["),
        (_first_positions(_scale), "demo_0: positions must be in metres and within 10 m of the base, found"),
    ],
)
def test_demonstrations_that_cannot_be_meant_are_refused(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], damage: Callable[[h5py.File], None], expected: str
) -> None:
    assert expected in refused(capsys, "fit", *SMALL, f"demos={damaged(made, tmp_path, damage)}")


def test_a_file_that_is_none_is_told_from_one_that_is_missing(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "must be a file, found nothing at nowhere.hdf5" in refused(capsys, "fit", "demos=nowhere.hdf5")
    assert "must be a file, found something else at" in refused(capsys, "fit", f"demos={made}")
    assert "must exist, found a folder there" in refused(
        capsys, "train", *SMALL, f"demos={made}/run/demos.hdf5", f"intent_file={made}"
    )


def test_inputs_that_do_not_belong_together_are_refused(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    demos, intent = f"demos={made}/other/demos.hdf5", f"intent={made}/run/intent.npz"
    assert "must be fitted to the demonstrations used" in refused(capsys, "train", *SMALL, demos, intent)
    assert "must be of task knife, found task shelf" in refused(capsys, "fit", "task=knife", demos)
    assert "must be of task shelf with the present settings" in refused(
        capsys, "eval", f"run={made}/run", "person.look_ahead_m=0.02"
    )
    assert "must be of task knife" in refused(capsys, "eval", f"run={made}/run", "task=knife")


@pytest.mark.parametrize(
    ("command", "inputs", "expected"),
    [
        ("fit", ("intent={run}/intent.npz",), "intent: must be left out, as koopdqn fit does not take it"),
        ("fit", ("run={run}",), "run: must be left out, as koopdqn fit does not take it"),
        ("report", ("run={run}",), "taken by: compare, correct, demo, eval, explain, export, stream, train, view"),
        ("eval", ("run={run}", "demos={run}/demos.hdf5"), "demos: must be left out, as koopdqn eval does not take it"),
        ("export", ("run={run}", "demos={run}/demos.hdf5"), "demos: koopdqn export takes either run= or demos="),
        ("correct", ("run={run}", "waypoints=[]"), "waypoints: must have at least 1 item"),
        ("correct", ("run={run}", "waypoints=/dev/null"), "must be a list of positions or a CSV file of them"),
        ("fit", ("demos={run}/demos.hdf5", "out={run}"), "out: must name a new or an empty folder"),
        ("eval", ("run={run}", "out={run}"), "out: must name a new or an empty folder"),
        ("train", ("run={run}", "out=x"), "out: train run=DIR goes on in DIR"),
        ("train", ("run={run}", "seed=9"), "can only go on with the config it began with"),
        ("eval", ("run={run}/policy.safetensors",), "run: must name the folder of a training run, found a file "),
        ("eval", ("run={run}/..",), "; it is a sweep's, whose runs are "),
        ("train", ("run={run}", "task=knife"), 'found task.name "knife" instead of "shelf"'),
        ("eval", ("run=null",), "run: must name a trained run, found none given and none below runs/"),
        ("eval", (), "run: must name a trained run, found none given and none below runs/"),
    ],
)
def test_an_input_is_read_by_the_command_or_refused(
    made: Path, capsys: pytest.CaptureFixture[str], command: str, inputs: tuple[str, ...], expected: str
) -> None:
    given = [item.format(run=made / "run") for item in inputs]
    before = contents(made / "run")
    assert expected in refused(capsys, command, *given)
    assert contents(made / "run") == before


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def _truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _edit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-5] ^= 0xFF
    path.write_bytes(bytes(content))


@pytest.mark.parametrize("damage", [_truncate, _empty, _edit, Path.unlink])
@pytest.mark.parametrize("name", ["policy.safetensors", "intent.npz", "demos.hdf5", "train.json"])
def test_a_run_with_a_damaged_file_is_not_measured(
    run_copy: Path, capsys: pytest.CaptureFixture[str], name: str, damage: Callable[[Path], None]
) -> None:
    damage(run_copy / name)
    line = refused(capsys, "eval", f"run={run_copy}")
    assert str(run_copy) in line
    assert "internal" not in line


@pytest.mark.parametrize("report", [[], {}, {"step_limit": "x"}, {"step_limit": 0}, {"step_limit": 1.5}])
def test_a_report_without_a_step_limit_is_refused(
    run_copy: Path, capsys: pytest.CaptureFixture[str], report: Any
) -> None:
    (run_copy / "train.json").write_text(json.dumps(report))
    assert "step_limit must be a whole number above 0" in refused(capsys, "eval", f"run={run_copy}")


@pytest.mark.parametrize("command", ["eval", "view", "explain", "export", "correct"])
def test_a_training_that_was_stopped_says_what_goes_on_with_it(
    run_copy: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    (run_copy / "policy.safetensors").unlink()
    message = refused(capsys, command, f"run={run_copy}")
    assert "run: must have been trained to its end, found it stopped on the way; koopdqn train run=" in message


@pytest.mark.parametrize("damage", [_truncate, _empty, _edit])
def test_a_damaged_checkpoint_is_not_gone_on_from_and_nothing_is_touched(
    run_copy: Path, capsys: pytest.CaptureFixture[str], damage: Callable[[Path], None]
) -> None:
    damage(run_copy / "checkpoints" / "latest.safetensors")
    before = contents(run_copy)
    assert "checkpoint file" in refused(capsys, "train", f"run={run_copy}")
    assert contents(run_copy) == before


@pytest.mark.parametrize(
    ("record", "expected"),
    [
        ("[", "cannot be read"),
        ("a: 1", "must be a list of at most 1000 overrides, found 'a: 1'"),
        ("", "must hold what it was begun with, found it stopped before it had begun"),
        ("- 5", "must be a list of overrides key=value of koopdqn's keys, found '5'"),
        ("- seed", "must be a list of overrides key=value of koopdqn's keys, found 'seed'"),
        ("- command=demo", "must name a run of 'train', found one of 'demo'"),
        ("- depth=1", "unknown key 'depth'; valid: actions"),
    ],
)
def test_a_damaged_record_of_overrides_is_refused(
    run_copy: Path, capsys: pytest.CaptureFixture[str], record: str, expected: str
) -> None:
    (run_copy / ".hydra" / "overrides.yaml").write_text(record)
    assert expected in refused(capsys, "train", f"run={run_copy}")


def test_a_run_goes_on_from_its_own_copies_of_its_inputs(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = tmp_path / "first"
    shutil.copytree(made / "run", first)
    inputs = [f"demos={first}/demos.hdf5", f"intent={first}/intent.npz"]
    assert cli.main(["train", *SOON, *inputs, "train.max_steps=700", "out=run"]) == 1
    shutil.rmtree(first)
    assert cli.main(["train", "run=run", "train.max_steps=1000000"]) == 0
    assert Path("run/policy.safetensors").read_bytes() == (made / "run" / "policy.safetensors").read_bytes()
    capsys.readouterr()
    other = f"demos={made}/other/demos.hdf5"
    assert "demos: must be those that the run holds in" in refused(capsys, "train", "run=run", other)


@pytest.mark.parametrize("name", ["5", "-1.5", "1e5", "1_000", "true", "NaN", "-inf"])
def test_a_path_named_like_a_number_is_a_path(name: str) -> None:
    assert prepare("demo", [f"out={name}"]).overrides[0] == f"out='{name}'"
    assert prepare("demo", [f"out=run{name}"]).overrides[0] == f"out=run{name}"
    assert f"import.pose='{name}'" in prepare("import", [f"import.pose={name}"]).overrides


def test_two_runs_of_one_second_get_a_folder_each() -> None:
    register_resolver(check=True)
    try:
        configs = [OmegaConf.create({"out": "${free_folder:runs/12-00-00-demo}"}) for _ in range(3)]
        names = [Path(config.out).name for config in configs]
        assert names == ["12-00-00-demo", "12-00-00-demo-2", "12-00-00-demo-3"]
        assert [Path(config.out).name for config in configs] == names
    finally:
        register_resolver(check=False)
    assert OmegaConf.create({"out": "${free_folder:runs/other}"}).out == "runs/other"
    assert sorted(path.name for path in Path("runs").iterdir()) == names


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_a_failure_of_the_work_and_keeps_the_old_file(tmp_path: Path, number: int) -> None:
    path = tmp_path / "x.json"
    path.write_text("old")
    with pytest.raises(WorkFailedError, match="must be writable, the system says"), atomic_path(path):
        raise OSError(number, "No space left on device")
    with pytest.raises(BadInputError, match="must be writable"), atomic_path(path):
        raise OSError(errno.EROFS, "Read-only file system")
    assert path.read_text() == "old"


def test_demonstrations_reach_the_disk_in_one_piece(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    demonstrations = read_hdf5(made / "run" / "demos.hdf5")

    def full(path: Path, content: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(WorkFailedError, match="No space left on device"):
        write_hdf5(tmp_path / "demos.hdf5", demonstrations)
    assert not (tmp_path / "demos.hdf5").exists()


def test_numbers_that_diverge_are_told_by_where_they_stand(tmp_path: Path) -> None:
    with pytest.raises(DivergedError, match=r"fit\.json\.error\.1: must be JSON compliant, so finite, found inf"):
        write_json(tmp_path / "fit.json", {"error": [0.5, float("inf")]})
    with pytest.raises(DivergedError, match="history: must be JSON compliant, so finite, found nan"):
        canonical_json({"history": float("nan")})


@pytest.mark.parametrize("key", ["reward.goal", "reward.size"])
def test_a_reward_that_training_would_diverge_from_is_refused(capsys: pytest.CaptureFixture[str], key: str) -> None:
    told = refused(capsys, "train", *SMALL, f"{key}=1e30")
    assert key in told
    assert "1e+30" in told


@pytest.mark.parametrize("command", ["demo", "fit", "train", "eval"])
def test_json_prints_nothing_of_an_error_on_standard_output(capsys: pytest.CaptureFixture[str], command: str) -> None:
    assert refused(capsys, command, "--json", "run=nowhere") != ""


def test_an_unknown_rendering_backend_lists_the_known_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("MUJOCO_GL", "vulkan")
    with pytest.raises(BadInputError, match="MUJOCO_GL 'vulkan'; valid: disable, egl, glfw, osmesa"):
        prepare_rendering()


def test_a_backend_is_asked_for_in_any_case_of_letters(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("MUJOCO_GL", " EGL")
    prepare_rendering(lambda library: True)
    assert os.environ["MUJOCO_GL"] == "egl"
