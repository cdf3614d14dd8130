import gc
import json
import os
import pickle
import signal
import subprocess
import sys
import textwrap
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf

from koopdqn import errors, resources
from koopdqn.app import cli
from koopdqn.app.hydra.application import CommandResult
from koopdqn.errors import BadInputError, WorkFailedError

CONFIG = """\
defaults: [_self_, task: shelf]
command: koopdqn
seed: 0
run: null
demos: null
intent_file: null
out: runs/${task.name}/${now:%Y-%m-%d_%H-%M-%S}-${command}
hydra:
  run: {dir: "${new_folder:${out}}"}
  sweep: {dir: "${new_folder:${out}}", subdir: "${hydra.job.num}"}
  job: {name: "${command}", chdir: false}
  hydra_logging: {handlers: {console: {stream: "ext://sys.stderr"}}}
  job_logging:
    handlers: {console: {stream: "ext://sys.stderr"}, file: {delay: true}}
"""

Run = Callable[[str, DictConfig, Path], CommandResult]


class Lab:
    """A working folder with a small config tree, and stand-in commands that record their calls."""

    def __init__(self, root: Path) -> None:
        self.calls: list[tuple[str, DictConfig, Path]] = []
        self.action: Run = self.succeed
        (root / "conf" / "task").mkdir(parents=True)
        (root / "conf" / "config.yaml").write_text(CONFIG)
        (root / "conf" / "task" / "shelf.yaml").write_text("name: shelf\nstep_m: 0.0021\n")
        (root / "conf" / "task" / "knife.yaml").write_text("name: knife\nstep_m: 0.0021\n")

    def run(self, command: str, config: DictConfig, folder: Path) -> CommandResult:
        self.calls.append((command, config, folder))
        return self.action(command, config, folder)

    def succeed(self, command: str, config: DictConfig, folder: Path) -> CommandResult:
        (folder / f"{command}.json").write_text("{}")
        return CommandResult({"seed": config.seed, "task": config.task.name}, lines=["all is [well]"])

    def fail_with(self, error: BaseException) -> None:
        def action(command: str, config: DictConfig, folder: Path) -> CommandResult:
            raise error

        self.action = action


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Lab:
    lab = Lab(tmp_path / "installed")
    commands = types.ModuleType("koopdqn.app.commands")
    commands.run = lab.run  # type: ignore[attr-defined]  # a stand-in for the module
    monkeypatch.setitem(sys.modules, "koopdqn.app.commands", commands)
    monkeypatch.setattr(resources, "roots", lambda: (tmp_path / "installed",))
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    return lab


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def refused(capsys: pytest.CaptureFixture[str], *arguments: str, status: int = 2) -> str:
    """Return the one line that a command line is refused with."""
    capsys.readouterr()
    assert cli.main(arguments) == status
    streams = capsys.readouterr()
    assert streams.out == ""
    assert streams.err.startswith("koopdqn: error: ")
    assert streams.err.count("\n") == 1
    return streams.err.removeprefix("koopdqn: error: ").rstrip("\n")


def test_a_run_gets_its_config_and_a_folder_of_its_own(lab: Lab, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["train", "task=knife", "seed=7"]) == 0
    [(command, config, folder)] = lab.calls
    assert (command, config.command, config.task.name, config.seed) == ("train", "train", "knife", 7)
    assert folder.parent == Path.cwd() / "runs" / "knife"
    assert names(folder) == [".hydra", "train.json"]
    assert names(folder / ".hydra") == ["config.yaml", "hydra.yaml", "overrides.yaml"]
    streams = capsys.readouterr()
    assert streams.out == "all is [well]\n"
    assert streams.err == ""


def free_names() -> None:
    """Let the run folder have a default name, as in the package's own config."""
    config = resources.conf_dir() / "config.yaml"
    text = config.read_text().replace("out: runs/${task.name}", "out: ${free_folder:runs/${task.name}")
    config.write_text(text.replace("-${command}\nhydra", "-${command}}\nhydra"))


def test_a_refused_command_leaves_no_folder_behind(lab: Lab, capsys: pytest.CaptureFixture[str]) -> None:
    free_names()
    lab.fail_with(BadInputError("demos: must exist"))
    assert refused(capsys, "train") == "demos: must exist"
    assert names(Path.cwd()) == []
    # Others' folders stay, and so does what the command wrote before, or the folder asked for.
    (Path.cwd() / "runs").mkdir()
    assert refused(capsys, "train") == "demos: must exist"
    assert names(Path.cwd()) == ["runs"]
    assert refused(capsys, "train", "out=mine") == "demos: must exist"
    assert names(Path.cwd()) == ["mine", "runs"]

    def write_and_fail(command: str, config: DictConfig, folder: Path) -> CommandResult:
        (folder / "demos.hdf5").write_text("")
        raise BadInputError("it must fit")

    lab.action = write_and_fail
    assert refused(capsys, "train") == "it must fit"
    [folder] = (Path.cwd() / "runs" / "shelf").iterdir()
    assert names(folder) == [".hydra", "demos.hdf5"]


def test_help_and_version_end_well(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in ([], ["--help"], ["-h"]):
        assert cli.main(arguments) == 0
        assert "doctor" in capsys.readouterr().out
    for name in ("demo", "fit", "train", "eval", "report"):
        assert cli.main([name, "--help"]) == 0
        assert "--multirun" in capsys.readouterr().out
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("koopdqn ")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["task=shlf"], "unknown option of task 'shlf'; valid: knife, shelf"),
        (["task.stp_m=1"], "unknown key task.stp_m; valid: name, step_m"),
        (["tsk=shelf"], "unknown key tsk; valid: demos, obstacles, out, preset, run, seed, task"),
        (["seed=[1"], "the override 'seed=[1' cannot be read: "),
        (["seed=1,2"], "Ambiguous value for argument 'seed=1,2'"),
        (["seed"], "an override must read key=value (such as task=shelf), found 'seed'"),
        (["+seed=1"], "Could not append to config. An item is already at 'seed'."),
        (["seed=${nowhere"], "the override 'seed=${nowhere' cannot be read"),
        (["out=${nowhere}"], "hydra.run.dir: Interpolation key 'nowhere' not found"),
        (["out="], "out: must name a folder, found ''"),
        (["task=null"], "task: must name an option, found null"),
        (["person=3"], "person: must name an option, found 3"),
        (["--sed", "3"], "unknown option --sed of koopdqn train; valid: --cfg, --config-dir"),
        (["--seed", "3"], "settings are given without dashes, as seed=3"),
        (["start=3"], "start: koopdqn train takes none, found '3'"),
        (["--json=1"], "Option '--json' does not take a value"),
        (["--cfg"], "Option '--cfg' requires an argument"),
        (["--cfg", "jb"], "'jb' is not one of"),
        (["--cfg", "job", "--json"], "--json: prints a command's result and cannot be combined with --cfg or --info"),
        (["--cfg", "job", "-p", "nowhere"], "package 'nowhere' not found in config"),
        (["--cfg", "job", "-m"], "Only one of --run, --multirun, --cfg, --info and --shell_completion"),
        (["--resolve"], "--package and --resolve: need --cfg, found none"),
        (["--config-dir", "nowhere"], "Additional config directory"),
        (["--config-path", "nowhere"], "Primary config directory not found"),
        (["--config-name", "nowhere"], "Cannot find primary config 'nowhere'"),
        (["run=nowhere"], "run: must name the folder of a training run, found no folder 'nowhere'"),
        (["-m", "seed=interval(0,1)"], "BasicSweeper does not support sweep type"),
        (
            ["hydra/launcher=ray"],
            "needs an extra, found it not installed: pip install 'koopdqn[ray]'",
        ),
        (["hydra/launcher=rocket"], "unknown option of hydra/launcher 'rocket'; valid: basic"),
    ],
)
def test_bad_input_is_one_line_and_exit_status_2(
    lab: Lab, capsys: pytest.CaptureFixture[str], arguments: list[str], expected: str
) -> None:
    assert expected in refused(capsys, "train", *arguments)
    assert lab.calls == []
    assert not Path("runs").exists()


def test_an_unknown_command_lists_the_commands(capsys: pytest.CaptureFixture[str]) -> None:
    assert refused(capsys, "trian").endswith(
        "valid: compare, correct, demo, doctor, eval, explain, export, feedback, fit, import, inspect, report, stream,"
        " train, view"
    )


@pytest.mark.parametrize("name", ["help", "version"])
def test_an_option_given_as_a_command_is_named(capsys: pytest.CaptureFixture[str], name: str) -> None:
    assert f"valid: --{name}, compare, " in refused(capsys, name)


def test_a_config_file_that_is_no_yaml_is_told(lab: Lab, capsys: pytest.CaptureFixture[str]) -> None:
    Path("mine/task").mkdir(parents=True)
    Path("mine/task/bad.yaml").write_text("name: [")
    assert "not valid YAML" in refused(capsys, "train", "--config-dir=mine", "task=bad")


def test_a_config_file_that_is_no_utf8_is_told(lab: Lab, capsys: pytest.CaptureFixture[str]) -> None:
    Path("mine/task").mkdir(parents=True)
    Path("mine/task/bad.yaml").write_bytes(b"name: caf\xe9\n")
    assert "must be UTF-8, found byte 0xe9" in refused(capsys, "train", "--config-dir=mine", "task=bad")


def test_an_existing_result_is_refused_before_anything_is_written(lab: Lab, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["train", "out=mine"]) == 0
    record = Path("mine/.hydra/overrides.yaml")
    before = record.read_bytes()
    for again in (["out=mine", "seed=1"], ["-m", "out=mine", "seed=1,2"]):
        text = refused(capsys, "train", *again)
        assert text == "out: must name a new or an empty folder, found 'mine', which holds train.json"
    for key, option in (
        ("hydra.run.dir", []),
        ("hydra.sweep.dir", ["-m", "seed=1,2"]),
        ("hydra.sweep.subdir", ["-m", "seed=1,2"]),
    ):
        text = refused(capsys, "train", *option, f"{key}=mine", "hydra.output_subdir=null")
        assert text == f"{key}: must be left out, since out= names the run folder, found mine"
    assert record.read_bytes() == before
    assert len(lab.calls) == 1


def test_an_output_folder_that_cannot_be_made_is_bad_input(lab: Lab, capsys: pytest.CaptureFixture[str]) -> None:
    Path("file").touch()
    assert "out: must name a folder that can be written" in refused(capsys, "train", "out=file/below")


def test_a_folder_name_with_odd_characters_works(lab: Lab) -> None:
    assert cli.main(["train", "out=my run (1)"]) == 0
    assert Path("my run (1)/train.json").is_file()


def test_json_leaves_nothing_else_on_standard_output(lab: Lab) -> None:
    done = run_in_subprocess(
        """
        def run(command, config, folder):
            print("a library chats")
            os.system("echo a child chats")
            os.write(1, b"C code chats")
            return CommandResult({"seed": config.seed}, lines=["for people"])
        """,
        "train",
        "--json",
    )
    assert json.loads(done.stdout) == {"seed": 0}
    for chat in ("a library chats", "a child chats", "C code chats"):
        assert chat in done.stderr
    assert done.returncode == 0


def test_a_sweep_makes_a_folder_a_job_and_a_json_line_a_job(lab: Lab, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["train", "-m", "seed=1,2", "out=sweep", "--json"]) == 0
    assert names(Path("sweep")) == ["0", "1", "multirun.yaml"]
    assert [json.loads(line)["seed"] for line in capsys.readouterr().out.splitlines()] == [1, 2]
    assert [folder.name for _, _, folder in lab.calls] == ["0", "1"]


def test_hydras_mode_can_be_set_by_an_override_or_a_config_of_ones_own(lab: Lab) -> None:
    assert cli.main(["train", "hydra.mode=MULTIRUN", "seed=1,2", "out=told"]) == 0
    Path("mine").mkdir()
    Path("mine/own.yaml").write_text("defaults: [config, _self_]\nhydra: {mode: MULTIRUN}\n")
    assert cli.main(["train", "--config-dir", "mine", "--config-name", "own", "seed=3,4", "out=held"]) == 0
    assert [config.seed for _, config, _ in lab.calls] == [1, 2, 3, 4]


def test_a_config_is_composed_once(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    from hydra._internal.hydra import Hydra

    composed: list[object] = []
    asked, compose = Hydra.get_mode, Hydra.compose_config

    def counted(self: Hydra, *given: Any, **named: Any) -> DictConfig:
        composed.append(given)
        return compose(self, *given, **named)

    monkeypatch.setattr(Hydra, "compose_config", counted)
    assert cli.main(["train", "seed=1"]) == 0
    assert len(composed) == 1
    assert Hydra.get_mode is asked


def test_a_sweep_over_tasks_stays_in_one_folder(lab: Lab) -> None:
    assert cli.main(["train", "-m", "task=shelf,knife"]) == 0
    assert len({folder.parent for _, _, folder in lab.calls}) == 1


def test_a_refused_sweep_leaves_its_folder_to_the_corrected_one(lab: Lab) -> None:
    assert cli.main(["train", "-m", "task=shelf,knif", "out=sweep"]) == 2
    assert cli.main(["train", "-m", "task=shelf,knife", "out=sweep"]) == 0
    assert names(Path("sweep")) == ["0", "1", "multirun.yaml"]


def test_a_failing_job_fails_its_sweep_after_the_others_ran(lab: Lab, capsys: pytest.CaptureFixture[str]) -> None:
    def action(command: str, config: DictConfig, folder: Path) -> CommandResult:
        if config.seed == 1:
            raise WorkFailedError("the goal cannot be reached")
        return lab.succeed(command, config, folder)

    lab.action = action
    assert cli.main(["train", "-m", "seed=1,2", "--json"]) == 1
    streams = capsys.readouterr()
    assert json.loads(streams.out)["seed"] == 2
    assert streams.err.endswith("koopdqn: error: the goal cannot be reached\n")


def test_a_result_may_say_that_the_work_failed(lab: Lab, capsys: pytest.CaptureFixture[str]) -> None:
    lab.action = lambda command, config, folder: CommandResult({"learned": False}, exit_status=config.seed)
    assert cli.main(["train", "seed=1", "--json"]) == 1
    assert json.loads(capsys.readouterr().out) == {"learned": False}
    assert cli.main(["train", "-m", "seed=0,1,0", "out=sweep"]) == 1


def test_sweepers_get_the_objective(lab: Lab, tmp_path: Path) -> None:
    from koopdqn.app.hydra.application import Job

    lab.action = lambda command, config, folder: CommandResult({}, objective=0.25)
    seen: list[Any] = []
    original = Job.__call__

    def spy(self: Job, config: DictConfig) -> float | None:
        objective = original(self, config)
        seen.append(objective)
        return objective

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Job, "__call__", spy)
        assert cli.main(["train"]) == 0
    assert seen == [0.25]


def test_a_job_can_be_sent_to_a_launchers_worker() -> None:
    from koopdqn.app.commands import run
    from koopdqn.app.hydra.application import Job

    job = Job("train", Path("outcomes"), as_json=True, record=None, work=run)
    assert pickle.loads(pickle.dumps(job)) == job


def test_cfg_prints_the_config_and_runs_nothing(lab: Lab, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["train", "--cfg", "job", "--resolve", "task=knife"]) == 0
    shown = OmegaConf.create(capsys.readouterr().out)
    assert (shown.command, shown.task.name) == ("train", "knife")
    assert cli.main(["train", "--cfg=job", "-p", "task"]) == 0
    assert capsys.readouterr().out == "# @package task\nname: shelf\nstep_m: 0.0021\n"
    assert cli.main(["train", "-c", "all", "-p", "hydra.run.dir"]) == 0
    assert lab.calls == []
    assert names(Path()) == []


def test_hydras_other_questions_are_answered(lab: Lab, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, expected in ((["--info"], "Config search path"), (["--hydra-help"], "Hydra")):
        assert cli.main(["train", *arguments]) == 0
        assert expected in capsys.readouterr().out
    assert cli.main(["train", "--info", "defaults-tree", "task=knife"]) == 0
    assert "task: knife" in capsys.readouterr().out
    assert lab.calls == []


def test_a_reader_that_goes_away_is_told_nothing() -> None:
    command = f"{sys.executable} -m koopdqn train --info | head -1"
    made = subprocess.run(command, shell=True, capture_output=True, text=True, check=True)
    assert made.stdout.startswith("Hydra")
    assert made.stderr == ""


def test_the_users_own_config_folder_adds_options(lab: Lab) -> None:
    Path("mine/task").mkdir(parents=True)
    Path("mine/task/sword.yaml").write_text("name: sword\nlength_m: 1.1\n")
    assert cli.main(["train", "--config-dir", "mine", "task=sword"]) == 0
    assert cli.main(["train", "-cd", "mine", "task=sword", "out=other"]) == 0
    assert [config.task.length_m for _, config, _ in lab.calls] == [1.1, 1.1]


def test_continuing_takes_the_recorded_overrides_and_leaves_the_record(lab: Lab) -> None:
    assert cli.main(["train", "task=knife", "seed=3", "out=mine"]) == 0
    before = {path.name: path.read_bytes() for path in Path("mine/.hydra").iterdir()}
    assert cli.main(["train", "run=mine", "task.step_m=0.003"]) == 0
    _, config, folder = lab.calls[1]
    assert (config.task.name, config.seed, config.task.step_m) == ("knife", 3, 0.003)
    assert (config.run, config.out, folder) == ("mine", "mine", Path.cwd() / "mine")
    assert {path.name: path.read_bytes() for path in Path("mine/.hydra").iterdir()} == before


def test_a_file_given_as_intent_is_the_intent_file(lab: Lab) -> None:
    assert cli.main(["train", "intent=runs/a/intent.npz"]) == 0
    assert lab.calls[0][1].intent_file == "runs/a/intent.npz"


@pytest.mark.parametrize(
    ("error", "status", "expected"),
    [
        (BadInputError("demos: must exist"), 2, "demos: must exist"),
        (WorkFailedError("not learned"), 1, "not learned"),
        (errors.KoopdqnError("odd\nlines"), 1, "odd lines"),
        (PermissionError(13, "Permission denied", "/data/x"), 2, "/data/x: Permission denied"),
        (OSError(30, "Read-only file system", "/data/x"), 2, "/data/x: Read-only file system"),
        (OSError(28, "No space left on device", "/data/x"), 1, "/data/x: No space left on device"),
        (OSError("truncated file"), 1, "truncated file"),
        (RuntimeError("bug"), 1, "internal error: RuntimeError: bug; run again with --debug"),
        (ValueError("bug"), 1, "internal error: ValueError: bug; run again with --debug"),
    ],
)
def test_an_error_of_the_work_is_one_line_with_its_status(
    lab: Lab, capsys: pytest.CaptureFixture[str], error: Exception, status: int, expected: str
) -> None:
    lab.fail_with(error)
    assert refused(capsys, "train", status=status) == expected


def test_debug_adds_the_traceback(lab: Lab, capsys: pytest.CaptureFixture[str]) -> None:
    lab.fail_with(BadInputError("demos: must exist"))
    assert cli.main(["train", "--debug"]) == 2
    streams = capsys.readouterr().err
    assert "Traceback (most recent call last)" in streams
    assert streams.endswith("koopdqn: error: demos: must exist\n")


def test_the_surroundings_are_left_as_they_were(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    lab.fail_with(RuntimeError("bug"))
    collects = gc.get_threshold()
    gc.set_threshold(701, 12, 13)
    before = sys.argv, sys.stdout, sys.stderr, signal.getsignal(signal.SIGTERM), Path.cwd(), gc.get_threshold()
    cli.main(["train", "--json"])
    after = sys.argv, sys.stdout, sys.stderr, signal.getsignal(signal.SIGTERM), Path.cwd(), gc.get_threshold()
    gc.set_threshold(*collects)
    assert before == after
    assert "HYDRA_FULL_ERROR" not in os.environ


def test_ctrl_c_is_one_line_and_130(lab: Lab, capsys: pytest.CaptureFixture[str]) -> None:
    lab.fail_with(KeyboardInterrupt())
    for arguments in (["train", "out=mine"], ["train", "-m", "seed=1,2"]):
        assert cli.main(arguments) == 130
        assert capsys.readouterr().err.endswith("koopdqn: interrupted; everything so far is kept\n")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_work_with_130_and_keeps_what_is_there(lab: Lab, number: signal.Signals) -> None:
    done = run_in_subprocess(
        f"""
        def run(command, config, folder):
            (folder / "part.txt").write_text("so far")
            os.kill(os.getpid(), {int(number)})
            time.sleep(30)
        """,
        "train",
        "out=mine",
    )
    assert done.returncode == 130
    assert "Traceback" not in done.stderr
    assert Path("mine/part.txt").read_text() == "so far"


def test_a_reader_that_goes_away_is_no_traceback(lab: Lab) -> None:
    done = run_in_subprocess(
        """
        def run(command, config, folder):
            return CommandResult({}, lines=["x" * 80] * 100_000)
        """,
        "train",
        pipe_to="head -n 1",
    )
    assert "Traceback" not in done.stderr
    assert "BrokenPipe" not in done.stderr


def test_the_shell_is_offered_groups_and_options(lab: Lab) -> None:
    environment = {"_KOOPDQN_COMPLETE": "complete_bash", "COMP_WORDS": "koopdqn train task=", "COMP_CWORD": "2"}
    done = run_in_subprocess("def run(*_): ...", environment=environment)
    assert done.stdout.split() == ["task=knife", "task=shelf"]


def run_in_subprocess(
    code: str, *arguments: str, pipe_to: str = "", environment: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process of its own, with ``code`` in place of koopdqn.app.commands."""
    root = resources.roots()[0]
    script = Path("run_koopdqn.py")
    script.write_text(
        "import os, sys, time, types, pathlib\n"
        "from koopdqn.app.hydra.application import CommandResult\n"
        "from koopdqn import resources\n"
        "from koopdqn.app.cli import main\n"
        f"{textwrap.dedent(code)}\n"
        f"resources.roots = lambda: (pathlib.Path({str(root)!r}),)\n"
        "sys.modules['koopdqn.app.commands'] = types.ModuleType('koopdqn.app.commands')\n"
        "sys.modules['koopdqn.app.commands'].run = run\n"
        "sys.exit(main())\n"
    )
    line = [sys.executable, str(script), *arguments]
    if pipe_to:
        line = ["sh", "-c", f'"$@" | {pipe_to}', "sh", *line]
    checkout = str(Path(cli.__file__).resolve().parent.parent)
    path = os.pathsep.join(filter(None, [checkout, os.environ.get("PYTHONPATH")]))
    variables = {**os.environ, "PYTHONPATH": path, **(environment or {})}
    return subprocess.run(line, capture_output=True, text=True, timeout=60, check=False, env=variables)
