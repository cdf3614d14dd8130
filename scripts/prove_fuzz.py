"""Inputs that might break koopdqn: damaged files for every reader, odd values for every config leaf, damaged runs."""

import contextlib
import io
import shutil
import subprocess
import sys
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any, Final

import numpy as np
import scipy.io
from prove import Case

from koopdqn import console
from koopdqn.app import cli
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.hydra.folder import ensure_resolver
from koopdqn.artifact import read_artifact
from koopdqn.demonstrations.recordings.load import KINDS, load
from koopdqn.errors import KoopdqnError
from koopdqn.evaluation.results import read_report
from koopdqn.evaluation.schema import EvaluationFile
from koopdqn.intent.storage import read_intent
from koopdqn.oracles.journal import read_records
from koopdqn.resources import conf_dir
from koopdqn.rl.policy import read_policy
from koopdqn.settings import plain
from koopdqn.tasks.task import Task
from koopdqn.tasks.workcell import open_workcell

FAMILIES: Final = ("files", "config leaves", "commands on damaged runs")
# Of a thousand inputs; a command takes a thousand times as long as a file.
_SHARES: Final = (0.93, 0.066, 0.004)
_ODD: Final[tuple[Any, ...]] = (
    *(
        None,
        True,
        False,
        "",
        " ",
        "nan",
        "x",
        "../x",
        "/etc/passwd",
        "${seed}",
        "${oc.env:HOME}",
        "{}",
        "\x1b[31m",
    ),
    *(0, -1, 1, 2, 7, 1 << 31, 1 << 63, 1 << 200, -(1 << 63), 0.0, -0.0, 0.5, -1.5, 1e-308, 1e308, -1e308, 1e-9),
    *(float("nan"), float("inf"), -float("inf"), [], {}, [0], [None], [[]], [1, 2, 3], [1e308] * 3, ["a"], {"a": 1}),
)
_TOKENS: Final = (b"nan", b"1e999", b"-", b"1_0", "１".encode(), b"9" * 400, b"\x00", b"\xff\xfe", b"{" * 200, b"\n\n")
_EXTREMES: Final = (bytes(8), b"\xff" * 8, b"\x7f" + b"\xff" * 7, b"\xff" * 7 + b"\x7f", b"\x00\x00\x00\x80" * 2)
_COMMANDS: Final = (
    ("eval", "run={run}", "eval.episodes=2", "eval.dynamics_episodes=1", "eval.baselines=false"),
    ("train", "run={run}"),
    ("export", "run={run}"),
    ("view", "run={run}", "view.starts=1"),
    ("fit", "demos={run}/demos.hdf5"),
    ("inspect", "demos={run}/demos.hdf5"),
    ("import", "demos={run}/feedback.jsonl"),
    ("report", "report.runs=[{run}]"),
    ("train", "oracle=replay", "journal={run}/feedback.jsonl", "task=shelf", "train.max_steps=500"),
)


class Fuzz:
    """Makes the cases of a seed from one small run and recordings of all kinds."""

    def __init__(self, seed: int, folder: Path) -> None:
        """Make the run and the recordings in a folder."""
        from small_run import SMALL

        self._seed, self._folder, self._small = seed, folder, SMALL
        self._run = folder / "run"
        made = ["train", *SMALL, f"out={self._run}"]
        measured = ["eval", f"run={self._run}", f"out={folder}/eval", "eval.episodes=2", "eval.baselines=false"]
        for words in (made, measured, ["export", f"demos={self._run}/demos.hdf5", f"out={folder}/csv"]):
            # In processes of their own: threads of what draws pictures do not survive the fork of the watched process.
            subprocess.run([sys.executable, "-m", "koopdqn", *words, "--json"], check=True, capture_output=True)
        self._config = self._composed()
        self._leaves = list(_leaves(self._config))
        task, arm = (getattr(Configuration.load(self._config), name) for name in ("task", "robot"))
        self._readers = _readers(self._run, folder, task, arm)

    def case(self, number: int) -> Case:
        """Return the case of a number."""
        rng = np.random.default_rng([self._seed, number])
        family = FAMILIES[int(rng.choice(len(FAMILIES), p=_SHARES))]
        make = {FAMILIES[0]: self._file, FAMILIES[1]: self._leaf, FAMILIES[2]: self._command}[family]
        return make(rng)

    def _file(self, rng: np.random.Generator) -> Case:
        name = str(rng.choice(sorted(self._readers)))
        source, read = self._readers[name]
        content = mutated(source.read_bytes(), rng)
        path = self._folder / "damaged" / source.name

        def run() -> tuple[str, str]:
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(content)
            return _ended(lambda: read(path))

        return Case(f"files: {name}", f"{len(content)} bytes", run)

    def _leaf(self, rng: np.random.Generator) -> Case:
        where = self._leaves[int(rng.integers(len(self._leaves)))]
        value = _ODD[int(rng.integers(len(_ODD)))]
        config = deepcopy(self._config)
        node = config
        for key in where[:-1]:
            node = node[key]
        node[where[-1]] = value

        def run() -> tuple[str, str]:
            def work() -> None:
                loaded = Configuration.load(config)
                loaded.shaped_by()
                if where[0] in ("task", "robot", "person"):
                    open_workcell(loaded.task, loaded.robot)

            return _ended(work)

        return Case("config leaves", f"{'.'.join(map(str, where))}={value!r}", run)

    def _command(self, rng: np.random.Generator) -> Case:
        words = _COMMANDS[int(rng.integers(len(_COMMANDS)))]
        files = sorted(path.relative_to(self._run) for path in self._run.rglob("*") if path.is_file())
        victim, other = (files[int(rng.integers(len(files)))] for _ in range(2))
        how = str(rng.choice(["mutated", "gone", "empty", "folder", "link", "other"]))
        seed = int(rng.integers(1 << 32))

        def run() -> tuple[str, str]:
            run_folder, out = self._folder / "given" / "run", self._folder / "given" / "out"
            shutil.rmtree(run_folder.parent, ignore_errors=True)
            shutil.copytree(self._run, run_folder)
            _damage(run_folder / victim, run_folder / other, how, np.random.default_rng(seed))
            ends = [] if words == ("train", "run={run}") else [f"out={out}"]
            return _commanded([word.format(run=run_folder) for word in words] + ends)

        return Case(f"commands: {words[0]}", f"{victim} {how} {other if how == 'other' else ''}", run)

    def _composed(self) -> dict[str, Any]:
        from hydra import compose, initialize_config_dir

        ensure_resolver()
        with initialize_config_dir(str(conf_dir()), version_base="1.3"):
            return dict(plain(compose("config", overrides=["out=x", "command=demo", *self._small])))


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """Return bytes with one to six damages."""
    data = bytearray(content)
    for _ in range(int(rng.integers(1, 7))):
        place, size = (int(rng.integers(len(data) + 1)) for _ in range(2))
        size = min(size, int(2 ** rng.uniform(0, 12)))
        kind = int(rng.integers(8))
        if kind <= 1 and place < len(data):
            data[place] ^= 1 << int(rng.integers(8))
        elif kind == 2:
            del data[place : place + size]
        elif kind == 3:
            data[place:place] = rng.bytes(int(rng.integers(1, 40)))
        elif kind == 4:
            data[place:place] = data[: min(size, 1 << 16)]
        elif kind == 5:
            data[place : place + 8] = _EXTREMES[int(rng.integers(len(_EXTREMES)))]
        elif kind == 6:
            token = _TOKENS[int(rng.integers(len(_TOKENS)))]
            data[place : place + len(token)] = token
        elif rng.random() < 0.2:
            del data[place:]
    return bytes(data)


def _leaves(node: Any, prefix: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    if isinstance(node, dict) and node:
        return [leaf for key, value in node.items() for leaf in _leaves(value, (*prefix, key))]
    return [prefix]


def _readers(run: Path, folder: Path, task: Task, arm: Any) -> dict[str, tuple[Path, Callable[[Path], object]]]:
    from recording_files import MATRICES, POSES, TIMES, XYZW, declared, written

    given = declared({"quaternion": "xyzw"})
    table = np.column_stack([TIMES, POSES[:, :3], XYZW])
    np.save(folder / "a.npy", table)
    np.savez_compressed(folder / "a.npz", T=MATRICES, stamp=TIMES)
    scipy.io.savemat(folder / "a.mat", {"log": {"time": TIMES, "T": MATRICES}}, do_compression=True)
    written(folder / "log.txt", "timestamp pos_x pos_y pos_z qx qy qz qw", table, delimiter=";")
    recordings = [folder / name for name in ("a.npy", "a.npz", "a.mat", "log.txt", "csv/demos.csv")]
    with contextlib.suppress(ImportError):
        recordings += [_foreign_hdf5(folder, table), _parquet(folder, table), _bag(folder)]
    for kind in KINDS:
        with contextlib.suppress(KoopdqnError):
            kind.load_library(folder)
    readers: dict[str, tuple[Path, Callable[[Path], object]]] = {
        path.name: (path, lambda path: load(path, given, arm)) for path in recordings
    }
    return readers | {
        "demos.hdf5": (run / "demos.hdf5", lambda path: load(path, given, arm)),
        "intent.npz": (run / "intent.npz", lambda path: read_intent(path, task)),
        "policy.safetensors": (run / "policy.safetensors", lambda path: read_policy(path, task)),
        "checkpoint": (run / "checkpoints" / "latest.safetensors", lambda path: read_artifact(path, "checkpoint")),
        "feedback.jsonl": (run / "feedback.jsonl", read_records),
        "eval.json": (folder / "eval" / "eval.json", lambda path: read_report(path, "report", EvaluationFile)),
    }


def _foreign_hdf5(folder: Path, table: np.ndarray) -> Path:
    import h5py

    with h5py.File(folder / "a.h5", "w") as file:
        for index in range(2):
            file[f"trial_{index}/time"] = table[:, 0]
            file.create_dataset(f"trial_{index}/ee_position", data=table[:, 1:4], compression="gzip")
            file[f"trial_{index}/ee_quaternion"] = table[:, 4:]
    return folder / "a.h5"


def _parquet(folder: Path, table: np.ndarray) -> Path:
    import pyarrow
    from pyarrow import parquet

    names = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
    parquet.write_table(pyarrow.table(dict(zip(names, table.T, strict=True))), folder / "a.parquet")
    return folder / "a.parquet"


def _bag(folder: Path) -> Path:
    from recording_files import POSES
    from test_recording_ros import Bag

    bag = Bag("ros1", folder)
    with bag.writer:
        bag.write("/pose", "geometry_msgs/msg/Pose", bag.poses(POSES))
    return bag.path


def _damage(path: Path, other: Path, how: str, rng: np.random.Generator) -> None:
    if how == "mutated":
        path.write_bytes(mutated(path.read_bytes(), rng))
    elif how == "other":
        path.write_bytes(other.read_bytes())
    else:
        path.unlink()
        if how == "empty":
            path.touch()
        elif how == "folder":
            path.mkdir()
        elif how == "link":
            path.symlink_to("/etc/hostname")


def _ended(work: Callable[[], object]) -> tuple[str, str]:
    try:
        work()
    except KoopdqnError as error:
        text = str(error)
        return ("refused" if error.exit_status == 2 else "failed", text) if "\n" not in text else ("wrong", text)
    return "done", ""


def _commanded(words: list[str]) -> tuple[str, str]:
    """Run a command in this process and judge how it ended."""
    said = io.StringIO()
    console.err.cache_clear()
    console.out.cache_clear()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        status = cli.main([*words, "--json"])
    text = said.getvalue()
    lines = [line for line in text.splitlines() if line.startswith("koopdqn: error: ")]
    detail = f"{' '.join(words)}: status {status}: {text[-200:]}"
    if status not in (0, 1, 2) or "internal error" in text or "Traceback" in text or len(lines) > 1:
        return "wrong", detail
    if status == 2 and len(lines) != 1:
        return "wrong", detail
    return ("done", "failed", "refused")[status], detail
