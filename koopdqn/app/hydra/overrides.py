"""What the command line does to the overrides it is given before Hydra reads them."""

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from koopdqn.errors import BadInputError
from koopdqn.settings import shown

PATH_KEYS: Final = (
    "out",
    "run",
    "demos",
    "intent_file",
    "oracle.journal",
    "oracle.questions",
    "oracle.answers",
    "report.sweep",
)
"""Keys whose value is a path: quoted for Hydra's grammar where it needs it, ``~`` expanded."""

_PLAIN_VALUE: Final = re.compile(r"[A-Za-z0-9_./-]*")
_NUMBER_OR_BOOLEAN: Final = re.compile(r"-?[\d._]*\d[\d._]*(e-?\d+)?|-?inf|nan|true|false", re.IGNORECASE)
"""Values that Hydra reads as something else than a text."""
_INTENT_SUFFIXES: Final = (".npz", ".safetensors")
_SHORT_NAMES: Final = {
    "journal": "oracle.journal",
    "source": "demo.source",
    "demos.place": "task.place",
    "sweep": "report.sweep",
}
_RECORD: Final = Path(".hydra") / "overrides.yaml"
_OWN_KEYS: Final = ("command", "out", "run")
_CONTINUED: Final = {"train": "a training run", "demo": "a recording"}
"""Commands that go on with ``run=DIR``, and what DIR is of."""
_TAKES_FILES: Final = ("import", "inspect")
"""Commands whose files may stand alone."""
_COPIES: Final = {"demos": "demos.hdf5", "intent_file": "intent.npz"}


@dataclass(frozen=True)
class Prepared:
    """What Hydra gets.

    Attributes:
        overrides: the overrides, in Hydra's grammar.
        continues: whether they go on with an earlier run of the command, in its folder.
    """

    overrides: list[str]
    continues: bool = False


def prepare(command: str, overrides: Sequence[str], *, multirun: bool = False) -> Prepared:
    """Return the overrides that Hydra gets for a command.

    - Every override must read ``key=value`` (or ``~key``), with Hydra's prefixes ``+``, ``++``, ``~``.
    - ``intent=FILE`` becomes ``intent_file=FILE``: the value holds a path separator, ends as an intent
      model does, or is an existing file. Any other value of ``intent`` picks from the config group.
    - ``journal=FILE`` becomes ``oracle.journal=FILE``, ``source=WHO`` becomes ``demo.source=WHO``,
      ``demos.place=`` becomes ``task.place=`` and ``sweep=DIR`` becomes ``report.sweep=DIR``.
    - Values of the `PATH_KEYS` are quoted when they hold characters of Hydra's grammar (a space, a
      bracket) or read as a number, and a leading ``~`` is the home folder.
    - ``train run=DIR`` goes on in DIR: the overrides recorded in ``DIR/.hydra`` come first, the new ones
      after them; the run folder is DIR and what ``DIR/.hydra`` holds is left alone. Inputs that DIR keeps
      a copy of are read from there, wherever the files first given are by now. Where another oracle is
      given, the recorded one's settings go. ``demo run=DIR`` goes on with a recording in the same way.
    - ``eval run=DIR`` measures the run in DIR: the overrides recorded there come first, so that task and
      robot are the run's own. Without ``run=`` the newest trained run below ``runs/`` is taken.
    - ``demos=`` may be a list in brackets, which is Hydra's own grammar, unless a file is named so.
    - ``import`` and ``inspect`` also take files alone, without ``demos=``.
    - ``import``, ``inspect`` and ``export`` work on demonstrations of any kind: without ``task=`` theirs is the one
      that demonstrations define.
    - ``command=`` is set to the command's name.

    Args:
        command: name of the subcommand.
        overrides: as given by the user.
        multirun: whether ``-m`` was given.

    Raises:
        BadInputError: an override is no override, ``command=`` was given, or ``run=`` names no run
            that can be continued.
    """
    if command in _TAKES_FILES:
        overrides = _with_files(overrides)
    prepared = [_prepare_one(override) for override in overrides]
    keys = [_key(override) for override in prepared]
    if "command" in keys:
        raise BadInputError(f"command: is set by the subcommand ({command}) and cannot be overridden")
    folders = [_value(override) for override in prepared if _key(override) == "run"]
    if command == "eval":
        named = bool(folders) and folders[-1] != "null"
        return _prepare_evaluation(prepared, folders[-1] if named else str(newest_trained_run()))
    if command in ("import", "inspect", "export") and "task" not in keys:
        prepared = ["task=demonstrated", *prepared]
    if command not in _CONTINUED or not folders or folders[-1] == "null":
        return Prepared([*prepared, f"command={command}"])
    if multirun:
        raise BadInputError(f"run: {command} run=DIR goes on in one folder and cannot be combined with --multirun")
    if "out" in keys:
        raise BadInputError(f"out: {command} run=DIR goes on in DIR, so that out= cannot be given as well")
    folder = folders[-1]
    copies = _COPIES if command == "train" else {}
    copied = [key for key, name in copies.items() if (Path(folder) / name).is_file()]
    recorded = [item for item in _recorded(folder, command) if _key(item) not in copied]
    given = {_name(override) for override in prepared}
    if "oracle" in given:
        # Who answers may change within a run; the settings were those of who answered before.
        recorded = [item for item in recorded if not _key(item).startswith("oracle.")]
    merged = [
        *(override for override in recorded if _name(override) not in given),
        *prepared,
        f"command={command}",
        f"out={_quoted(folder)}",
        f"hydra.run.dir={_quoted(folder)}",
        "hydra.output_subdir=null",
    ]
    return Prepared(merged, continues=True)


def _with_files(overrides: Sequence[str]) -> list[str]:
    """Return the overrides, files that stand alone gathered in ``demos=``."""
    files = [each for each in overrides if "=" not in each and (not each.startswith("~") or each.startswith("~/"))]
    files += [each for each in overrides if each not in files and "=" in each and Path(each).exists()]
    rest = [each for each in overrides if each not in files]
    if not files:
        return rest
    if any(_key(each) == "demos" for each in rest):
        raise BadInputError(f"demos: must be given by demos= or by files alone, found both: {files[0]}")
    return [f"demos=[{','.join(_literal(str(Path(each).expanduser())) for each in files)}]", *rest]


def newest_trained_run(below: Path = Path("runs")) -> Path:
    """Return the folder of the newest finished training run below a folder.

    Raises:
        BadInputError: there is none.
    """
    finished = [path for path in below.rglob("train.json") if (path.parent / "policy.safetensors").is_file()]
    if not finished:
        raise BadInputError(f"run: must name a trained run, found none given and none below {below}/; train one first")
    return max(finished, key=lambda path: path.stat().st_mtime_ns).parent


def _prepare_evaluation(prepared: list[str], folder: str) -> Prepared:
    recorded = _recorded(folder, "train")
    given = {_name(override) for override in prepared}
    # A run's own inputs lie in its folder, and its outcome does not depend on how many are evaluated.
    own = [item for item in recorded if _name(item) not in given and _key(item) not in ("demos", "intent_file")]
    rest = [item for item in prepared if _key(item) != "run"]
    return Prepared([*own, *rest, f"run={_quoted(folder)}", "command=eval"])


def _prepare_one(override: str) -> str:
    name, equals, value = override.partition("=")
    if not _is_override(override):
        raise BadInputError(f"an override must read key=value, found {shown(override)}")
    if name == "intent" and _is_path(value):
        name = "intent_file"
    name = _SHORT_NAMES.get(name, name)
    if name in PATH_KEYS and not (name == "demos" and _is_list(value)):
        value = _quoted(value)
    return f"{name}{equals}{value}"


def _is_override(text: str) -> bool:
    name, equals, _ = text.partition("=")
    return text.startswith("~") or bool(equals and name.strip("+ "))


def _is_list(value: str) -> bool:
    return value.startswith("[") and value.endswith("]") and not Path(value).exists()


def _is_path(value: str) -> bool:
    text = _unquoted(value)
    separators = [s for s in (os.sep, os.altsep) if s]
    return (
        any(s in text for s in separators)
        or text.lower().endswith(_INTENT_SUFFIXES)
        or text == "~"
        or (bool(text) and Path(text).is_file())
    )


def _quoted(value: str) -> str:
    if value.startswith("~"):
        try:
            value = str(Path(value).expanduser())
        except RuntimeError as error:
            raise BadInputError(f"a path that begins with ~ must name a home folder, found {value!r}") from error
    # quotes, interpolations and lists for a sweep are the user's own grammar
    if value[:1] in ("'", '"') or "${" in value or "," in value:
        return value
    if _PLAIN_VALUE.fullmatch(value) and not _NUMBER_OR_BOOLEAN.fullmatch(value):
        return value
    return _literal(value)


def _literal(value: str) -> str:
    """Return a text in quotes of Hydra's grammar."""
    # in Hydra's quotes a backslash is an ordinary character unless it stands before a quote
    escaped = re.sub(r"(\\*)('|$)", lambda m: m[1] * 2 + ("\\'" if m[2] else ""), value)
    return f"'{escaped}'"


def _unquoted(value: str) -> str:
    if len(value) > 1 and value[0] == value[-1] and value[0] in "'\"":
        return re.sub(rf"(\\*)\\({value[0]})", lambda m: m[1][::2] + m[2], value[1:-1])
    return value


def _name(override: str) -> str:
    return override.partition("=")[0]


def _key(override: str) -> str:
    return _name(override).lstrip("+~").partition("@")[0]


def _value(override: str) -> str:
    return _unquoted(override.partition("=")[2])


def _recorded(folder: str, command: str) -> list[str]:
    from omegaconf import OmegaConf

    what = _CONTINUED[command]
    if not folder.strip():
        raise BadInputError(f"run: must name the folder of {what}, found ''")
    path = Path(folder)
    if not path.is_dir():
        raise BadInputError(f"run: must name the folder of {what}, found no folder {folder!r}")
    record = path / _RECORD
    if not record.is_file():
        raise BadInputError(f"run: must name the folder of {what}, found no {_RECORD} in {folder!r}")
    if not record.stat().st_size:
        raise BadInputError(f"run: {folder!r} must hold what it was begun with, found it stopped before it had begun")
    try:
        content = OmegaConf.to_container(OmegaConf.load(record), resolve=False)
    # the file may hold anything, and the YAML parser has errors of its own
    except Exception as error:
        raise BadInputError(f"run: {record} cannot be read ({type(error).__name__})") from error
    if not isinstance(content, list) or not all(isinstance(item, str) and _is_override(item) for item in content):
        raise BadInputError(f"run: {record} must be a list of overrides, found {shown(content)}")
    _check_command(content, command, folder)
    return [item for item in content if _key(item) not in _OWN_KEYS]


def _check_command(recorded: Iterable[str], command: str, folder: str) -> None:
    commands = [_value(item) for item in recorded if _key(item) == "command"]
    if commands and commands[-1] != command:
        raise BadInputError(f"run: must name a run of {command!r}, found one of {commands[-1]!r} in {folder!r}")
