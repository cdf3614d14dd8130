"""Hydra behind the commands: compose the config, run one job or a sweep, hand back what came of it."""

import contextlib
import io
import json
import logging
import os
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, cast

from rich.console import RenderableType

from koopdqn import console
from koopdqn.app.hydra.compose import composed
from koopdqn.app.hydra.folder import register_resolver, release_taken, require_new
from koopdqn.app.hydra.overrides import going_on
from koopdqn.errors import BadInputError
from koopdqn.files import atomic_path
from koopdqn.resources import conf_dir
from koopdqn.run_folder import RECORD, locked

if TYPE_CHECKING:
    from omegaconf import DictConfig


@dataclass(frozen=True)
class CommandResult:
    """The outcome of a command.

    Attributes:
        result: what the command's result file holds; ``--json`` prints it. JSON values only, no NaN.
        lines: what a person reads on standard output without ``--json``: texts (plain, no markup) or Rich
            renderables.
        objective: the value returned to Hydra's sweepers, or None.
        exit_status: 0 done, 1 the work itself failed (not learned).
    """

    result: dict[str, Any]
    lines: Sequence[RenderableType] = field(default_factory=tuple)
    objective: float | None = None
    exit_status: int = 0


_CONFIG = "config"

Work = Callable[[str, "DictConfig", Path], CommandResult]
"""What a command does: its name, the composed config and the run folder, to a result."""

# A launcher's worker process imports this module to run a job, and reads configs that use the resolver.
register_resolver(check=False)


@dataclass(frozen=True)
class Job:
    """One command on one composed config: the function that Hydra runs, here or in a worker process.

    Attributes:
        command: name of the subcommand.
        outcomes: folder that receives each job's outcome as ``<number>.json``.
        as_json: whether the result is kept for ``--json`` instead of being printed for people.
        record: what the record of a run that goes on is to say; None for a new run.
        work: workers import it by its name.
    """

    command: str
    outcomes: Path
    as_json: bool
    record: Sequence[str] | None
    work: Work

    def __call__(self, config: "DictConfig") -> float | None:
        """Run the command and return its objective (for sweepers); the config comes from Hydra."""
        from hydra.core.hydra_config import HydraConfig

        hydra = HydraConfig.get()
        folder = Path(hydra.runtime.output_dir)
        if self.record is None:
            require_new(folder, ignore=f"{hydra.job.name}.log")
        global _continued
        _continued = None if self.record is None else (self.record, folder)
        with locked(folder):
            outcome = self.work(self.command, config, folder)
        number = int(hydra.job.num) if in_sweep() else 0
        record = {"exit_status": outcome.exit_status, "sweep": in_sweep(), "result": outcome.result}
        text = json.dumps(record, allow_nan=False)
        (self.outcomes / f"{number:08d}.json").write_text(text, encoding="utf-8")
        if not self.as_json:
            for line in outcome.lines:
                console.say(line)
        return outcome.objective


_continued: tuple[Sequence[str], Path] | None = None
"""What the record of the run that the present job goes on with is to say, and its folder."""


def record_continued() -> None:
    """Write down what a run goes on with, so that it does so another time too; a new run's is Hydra's to write.

    To be called once the run is known to take it: what it refuses leaves the record alone.
    """
    from omegaconf import OmegaConf

    global _continued
    if _continued is None:
        return
    record, folder = _continued
    _continued = None
    config = composed([*record, *search_path()])
    for name, content in ((RECORD.name, OmegaConf.create(list(record))), ("config.yaml", config)):
        with atomic_path(folder / RECORD.with_name(name)) as path:
            path.write_text(OmegaConf.to_yaml(content), encoding="utf-8")


def given_now(key: str) -> list[str]:
    """Return the present command's overrides of a key."""
    from hydra.core.hydra_config import HydraConfig

    if not HydraConfig.initialized():
        return []
    overrides = HydraConfig.get().overrides
    return [each for each in (*overrides.hydra, *overrides.task) if each.partition("=")[0].lstrip("+") == key]


def search_path() -> list[str]:
    """Return the present command's override of where options are searched, if it has one."""
    return given_now("hydra.searchpath")


def own_options() -> list[str]:
    """Return the words that give another command the present one's config folder, its name, and its search path."""
    from hydra.core.hydra_config import HydraConfig

    if not HydraConfig.initialized():
        return []
    hydra, option = HydraConfig.get(), {"command-line": "--config-dir", "main": "--config-path"}
    folders = [
        f"{option[source.provider]}={source.path}"
        for source in hydra.runtime.config_sources
        if source.provider in option and source.path != str(conf_dir())
    ]
    named = [] if hydra.job.config_name == _CONFIG else [f"--config-name={hydra.job.config_name}"]
    return [*folders, *named, *search_path()]


def program() -> list[str]:
    """Return the words by which this program was started: as a module it finds others in the present folder."""
    started = Path(sys.argv[0])
    as_module = (started.parent.name, started.name) == ("koopdqn", "__main__.py")
    return ["python", "-m", "koopdqn"] if as_module else ["koopdqn"]


def how_to_go_on(command: str, folder: Path) -> str:
    """Return what goes on with a run of a command in its folder, as a shell takes it: "koopdqn … goes on"."""
    command, *rest = going_on(command, folder)
    return f"{shlex.join([*program(), command, *own_options(), *rest])} goes on"


def run(
    command: str,
    options: Sequence[str],
    overrides: Sequence[str],
    work: Work,
    *,
    as_json: bool,
    record: Sequence[str] | None,
) -> int:
    """Run a command under Hydra and return its exit status: the worst one of a sweep.

    ``options`` are Hydra's own (``["--multirun"]``), ``overrides`` are prepared. With ``as_json`` the result goes to
    standard output as JSON (a line a job in a sweep), and nothing else does. What composing or the job raises is passed
    on unchanged.
    """
    # Other machines share the folder that the runs lie in, not this one's for what is temporary.
    elsewhere = not {"hydra/launcher=submitit_slurm", "hydra/launcher=ray"}.isdisjoint(overrides)
    with tempfile.TemporaryDirectory(prefix=".koopdqn-", dir=Path.cwd() if elsewhere else None) as outcomes:
        job = Job(command, Path(outcomes), as_json, record, work)
        try:
            with _stdout_to_stderr() if as_json else contextlib.nullcontext():
                _call_hydra(job, [*options, *overrides], check_folder=True)
        finally:
            records = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(Path(outcomes).iterdir())]
            if as_json:
                _print_json(records)
    return max((int(record["exit_status"]) for record in records), default=0)


def show(options: Sequence[str], overrides: Sequence[str]) -> int:
    """Let Hydra print something about the config (``--cfg``, ``--info``, ``--hydra-help``) and run nothing.

    Raises:
        BadInputError: Hydra could not show it.
    """
    messages = io.StringIO()
    # Hydra logs what it shows: of a reader that goes away (`| head`) every line would be told as an error.
    before, logging.raiseExceptions = logging.raiseExceptions, False
    try:
        with contextlib.redirect_stderr(messages):
            # Hydra shows and calls nothing.
            _call_hydra(lambda config: None, [*options, *overrides], check_folder=False)
    except SystemExit as stop:
        if stop.code:
            raise BadInputError(" ".join(messages.getvalue().split()) or "Hydra could not show this") from stop
    finally:
        logging.raiseExceptions = before
    if messages.getvalue():
        console.note(messages.getvalue())
    return 0


def _call_hydra(job: Callable[["DictConfig"], float | None], arguments: Sequence[str], *, check_folder: bool) -> None:
    import hydra
    from hydra.core.global_hydra import GlobalHydra

    GlobalHydra.instance().clear()
    register_resolver(check=check_folder)
    argv, full = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    log = logging.getLogger()
    handlers, level = log.handlers[:], log.level
    # hydra.main reads the command line itself, and with this variable lets errors through to the caller
    sys.argv = [sys.argv[0], *arguments]
    os.environ["HYDRA_FULL_ERROR"] = "1"
    refused = False
    try:
        # Hydra adds a line of its own for a failed job, which says nothing the error does not
        line = contextlib.redirect_stderr(cast(TextIO, _WithoutHydraLine(sys.stderr)))
        with line, _composed_once(arguments):
            hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name=_CONFIG)(job)()
    except BadInputError:
        refused = True
        raise
    finally:
        sys.argv = argv
        log.handlers[:] = handlers
        log.setLevel(level)
        if full is None:
            os.environ.pop("HYDRA_FULL_ERROR", None)
        else:
            os.environ["HYDRA_FULL_ERROR"] = full
        register_resolver(check=False)
        release_taken(refused=refused)


@contextlib.contextmanager
def _composed_once(arguments: Sequence[str]) -> Iterator[None]:
    """Spare Hydra its first composing, which only looks for hydra.mode, where nothing given can set it."""
    from hydra._internal.hydra import Hydra

    kind: Any = Hydra
    asked = kind.get_mode

    def unset(*_given: object, **_named: object) -> None:
        # A command that the job itself calls may be given another.
        kind.get_mode = asked

    if not any(word.startswith("--config") or "hydra." in word for word in arguments):
        kind.get_mode = unset
    try:
        yield
    finally:
        kind.get_mode = asked


@contextlib.contextmanager
def _stdout_to_stderr() -> Iterator[None]:
    """Send what libraries and child processes print to standard error, so that only JSON is left on stdout."""
    sys.stdout.flush()
    saved = None
    with contextlib.suppress(OSError, ValueError):
        if sys.stdout.fileno() == 1:
            saved = os.dup(1)
            os.dup2(2, 1)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        if saved is not None:
            os.dup2(saved, 1)
            os.close(saved)


def _print_json(records: Sequence[Mapping[str, Any]]) -> None:
    for record in records:
        print(json.dumps(record["result"], allow_nan=False, indent=None if record["sweep"] else 2))
    sys.stdout.flush()


def in_sweep() -> bool:
    """Return whether the present command is a job of a sweep (``-m``)."""
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    return HydraConfig.initialized() and bool(HydraConfig.get().mode == RunMode.MULTIRUN)


class _WithoutHydraLine:
    """Standard error less the line by which Hydra announces that a job failed."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        if text.startswith("Error executing job with overrides:"):
            return len(text)
        return self._stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
