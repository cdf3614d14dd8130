"""What the command line does to the overrides it is given before Hydra reads them."""

import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from koopdqn.app.command_table import COMMANDS
from koopdqn.app.hydra.obstacles import obstacles_of, with_meshes_read
from koopdqn.app.hydra.record import GROUPS, PATH_NAMES, Recorded, check_record, read_record, said_again
from koopdqn.console import shown_path
from koopdqn.errors import BadInputError
from koopdqn.run_folder import DEMONSTRATIONS, INTENT, JOURNAL, newest_trained_run
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
    "view.video",
    "robot.path",
    "correct.waypoints",
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
    "start": "program.start",
    "host": "stream.host",
    "waypoints": "correct.waypoints",
}
FILE_KEYS: Final = (
    *PATH_KEYS,
    *(short for short, key in _SHORT_NAMES.items() if key in PATH_KEYS),
    *("intent", "obstacles", "video"),
)
"""What the user types before a path."""
_OF_THE_COMMAND_LINE: Final = ("command", "out", "run", "intent_file", "trust_modules")
"""Keys without effect from Python."""
_HYDRAS: Final = ("hydra.", "hydra/")
_FOLDERS: Final = ("hydra.run.dir", "hydra.sweep.dir", "hydra.sweep.subdir")
"""Where Hydra would write before anything could be refused."""
_COPIES: Final = {"demos": DEMONSTRATIONS, "intent_file": INTENT}
"""Inputs that a run keeps a copy of, and its name."""


@dataclass(frozen=True)
class Prepared:
    """What Hydra gets.

    Attributes:
        overrides: the overrides, in Hydra's grammar.
        record: what the record of a run that goes on is to say from now on; None for a new run.
    """

    overrides: list[str]
    record: list[str] | None = None


def prepare(command: str, overrides: Sequence[str], *, multirun: bool = False) -> Prepared:
    """Return the overrides that Hydra gets for a command, by what the table says of it.

    - Every override must read ``key=value`` (or ``~key``), with Hydra's prefixes ``+``, ``++``, ``~``.
    - Short names become long ones (`_SHORT_NAMES`, and the command's ``own_keys``), and ``obstacles=FILE`` becomes
      ``task.obstacles=`` with what the file holds.
    - ``intent=FILE`` becomes ``intent_file=FILE``: the value holds a path separator, ends as an intent
      model does, or is an existing file. Any other value of ``intent`` picks from the config group.
    - Values of the `PATH_KEYS`, and the name of ``import.pose=``, are quoted when they hold characters of Hydra's
      grammar (a space, a bracket) or read as a number, and a leading ``~`` is the home folder. ``demos=`` may be a list
      in brackets, which is Hydra's own grammar, unless a file is named so.
    - Where a command goes on in DIR the overrides recorded in ``DIR/.hydra`` come first, the new ones after them; the
      run folder is DIR, whose record takes the new ones once a training has. The record is data
      (:mod:`koopdqn.app.hydra.record`), never an order to Hydra. Inputs that DIR keeps a copy of are read from there,
      wherever the files first given are by now. Where another oracle is given, the recorded one's settings go.
    - Where it looks at a trained run the overrides recorded there come first, so that task and robot are the run's own;
      of several runs, those of the first.
    - Demonstrations of any task are of the one that they define, unless ``task=`` is given.
    - ``command=`` is set to the command's name.

    Args:
        command: name of the subcommand.
        overrides: as given by the user.
        multirun: whether ``-m`` was given.

    Raises:
        BadInputError: an override is no override, ``command=`` was given, or ``run=`` names no run
            that can be continued.
    """
    what = COMMANDS[command]
    if what.demos == "files":
        overrides = _with_files(overrides)
    if what.most_runs > 1:
        overrides = _with_runs(overrides, what.most_runs)
    prepared = [_prepare_one(command, override) for override in overrides]
    keys = [_key(override) for override in prepared]
    if own := next((override for override in prepared if _key(override) in _FOLDERS), None):
        rule = "must be left out, since out= names the run folder"
        raise BadInputError(f"{_key(own)}: {rule}, found {_value(own)}")
    if "command" in keys:
        raise BadInputError(f"command: is set by the subcommand ({command}) and cannot be overridden")
    if what.once and multirun:
        raise BadInputError(f"--multirun: koopdqn {command} {what.once}, found it asked for several")
    named = [_value(override) for override in prepared if _key(override) == "run"]
    folder = named[-1] if named and named[-1] != "null" else None
    any_task = what.demos in ("any", "files")
    shows_demonstrations = any_task and "demos" in keys
    if what.looks_at and folder is not None and shows_demonstrations:
        raise BadInputError(f"demos: koopdqn {command} takes either run= or demos=, found both")
    if what.most_runs > 1:
        _check_compared(prepared)
    if what.looks_at == "needed" and folder is None:
        raise BadInputError(f"run: must name the trained run to {command}, found none")
    if what.looks_at == "newest" and folder is None and not shows_demonstrations:
        folder = str(newest_trained_run())
    if what.looks_at and folder is not None:
        return _looking_at(folder, command, prepared)
    if any_task and "task" not in keys:
        prepared = ["task=demonstrated", *prepared]
    if what.goes_on_with and folder is not None:
        return _going_on_in(folder, command, prepared, multirun=multirun)
    return Prepared([*prepared, f"command={command}"])


def _going_on_in(folder: str, command: str, prepared: Sequence[str], *, multirun: bool) -> Prepared:
    keys = [_key(override) for override in prepared]
    if multirun:
        raise BadInputError(f"run: {command} run=DIR goes on in one folder and cannot be combined with --multirun")
    if "out" in keys:
        raise BadInputError(f"out: {command} run=DIR goes on in DIR, so that out= cannot be given as well")
    given = {_name(override) for override in prepared}
    recorded = [item for item in _recorded(folder, command) if item.name not in given]
    if "oracle" in given:
        # Who answers may change within a run; the settings were those of who answered before.
        recorded = [item for item in recorded if item.root != "oracle"]
    copied = _copied(Path(folder), recorded)
    # That an intent was given still says whose settings hold.
    own_intent = "intent_file" in copied and any(item.key == "intent_file" for item in recorded)
    paths = [key for key in keys if key.rpartition(".")[2] in PATH_NAMES]
    merged = [
        *check_record(recorded, Path(folder), _trusted(prepared), [*paths, *copied]),
        *([f"intent_file={_text(f'{folder}/{INTENT}')}"] if own_intent else []),
        *(f"run={_text(folder)}" if _key(each) == "run" else each for each in prepared),
        f"command={command}",
        f"out={_text(folder)}",
        f"hydra.run.dir={_text(folder)}",
        "hydra.output_subdir=null",
    ]
    given_now = [each for each in prepared if _key(each) != "run" and not _key(each).startswith(_HYDRAS)]
    return Prepared(merged, [*(item.text for item in recorded), *given_now])


def going_on(command: str, folder: Path) -> list[str]:
    """Return the words after ``koopdqn`` that go on with a run of a command in its folder.

    They are told where something went wrong already: a record that is missing or damaged raises nothing.
    """
    recorded: list[Recorded] = []
    with suppress(BadInputError, OSError):
        recorded = _recorded(str(folder), command)
    return [command, f"run={shown_path(folder)}", *said_again(recorded, _copied(folder, recorded))]


def _with_files(overrides: Sequence[str]) -> list[str]:
    """Return the overrides, files that stand alone gathered in ``demos=``."""
    files = [each for each in overrides if "=" not in each and (not each.startswith("~") or each.startswith("~/"))]
    files += [each for each in overrides if each not in files and "=" in each and _exists(each)]
    rest = [each for each in overrides if each not in files]
    if not files:
        return rest
    if any(_key(each) == "demos" for each in rest):
        raise BadInputError(f"demos: must be given by demos= or by files alone, found both: {files[0]}")
    return [f"demos=[{','.join(literal(str(Path(each).expanduser())) for each in files)}]", *rest]


def _with_runs(overrides: Sequence[str], most: int) -> list[str]:
    """Return the overrides with every ``run=DIR`` gathered in ``compare.runs=``, the first of them kept."""
    named = [_value(each) for each in overrides if _key(each) == "run"]
    folders = [str(Path(each).expanduser()) if each.startswith("~") else each for each in named]
    rest = [each for each in overrides if _key(each) != "run"]
    if any(_key(each) == "compare.runs" for each in rest):
        raise BadInputError("compare.runs: is given as run=DIR run=DIR, found compare.runs=")
    if not 2 <= len(folders) <= most:
        raise BadInputError(f"run: koopdqn compare needs 2 to {most} runs (run=DIR run=DIR), found {len(folders)}")
    return [*rest, f"run={_text(folders[0])}", f"compare.runs=[{','.join(map(literal, folders))}]"]


def _check_compared(prepared: Sequence[str]) -> None:
    """Raise BadInputError for what ``compare`` would not heed: its runs are what they were trained as."""
    heeded = ("run", "compare", "out", "eval", "trust_modules", "hydra")
    for override in prepared:
        key = _key(override)
        if key not in ("view.starts", "robot.path") and key.partition(".")[0] not in heeded:
            raise BadInputError(f"{key}: koopdqn compare shows its runs as they were trained, found {shown(override)}")


def _looking_at(folder: str, command: str, prepared: Sequence[str]) -> Prepared:
    given = {_name(override) for override in prepared}
    every = _recorded(folder, "train", measured=True)
    # A run's own inputs lie in its folder, and nobody is asked any more.
    unread = ["demos", "intent_file", "oracle"]
    arms = [_value(each) for each in prepared if _key(each) == "robot"]
    if arms and any(item.key == "robot" and item.value != arms[-1] for item in every):
        # The recorded arm's own numbers are not the other's.
        unread.append("robot")
    recorded = [item for item in every if item.name not in given and item.root not in unread]
    own = check_record(recorded, Path(folder), _trusted(prepared), [])
    rest = [item for item in prepared if _key(item) != "run"]
    return Prepared([*own, *rest, f"run={_text(folder)}", f"command={command}"])


def _copied(folder: Path, recorded: Iterable[Recorded]) -> list[str]:
    """Return the keys of the inputs that a run keeps a copy of."""
    copied = [key for key, name in _COPIES.items() if (folder / name).is_file()]
    # A person's answers are added to those that the run began with; a replay reads its journal to the end.
    at_terminal = any(item.key == "oracle" and item.value == "terminal" for item in recorded)
    return [*copied, "oracle.journal"] if at_terminal and (folder / JOURNAL).is_file() else copied


def _trusted(prepared: Iterable[str]) -> list[str]:
    """Return the modules of ``trust_modules=``."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    found: list[str] = []
    for item in prepared:
        if _key(item) == "trust_modules":
            value = OverridesParser.create().parse_override(item).value()
            found += [str(each) for each in (value if isinstance(value, list) else [value])]
    return found


def as_hydra_takes_it(override: str) -> str:
    """Return an override of ``koopdqn train`` as Hydra takes it, its short name written out.

    Raises:
        BadInputError: it is no override, names a file that cannot be read, or is of a key that nothing but the command
            line reads.
    """
    prepared = _prepare_one("train", override)
    key = _key(prepared)
    if key in _OF_THE_COMMAND_LINE or key.startswith(_HYDRAS):
        named = key.removesuffix("_file")
        raise BadInputError(f"{named}: must be left out, as nothing but the command line reads it, found {override}")
    return prepared


def _prepare_one(command: str, override: str) -> str:
    name, equals, value = override.partition("=")
    if not (override.startswith("~") or (equals and name.strip("+ "))):
        raise BadInputError(f"an override must read key=value (such as task=shelf), found {shown(override)}")
    if name == "intent" and _is_path(value):
        name = "intent_file"
    if name in GROUPS and (value == "null" or _NUMBER_OR_BOOLEAN.fullmatch(value)):
        raise BadInputError(f"{name}: must name an option, found {value}")
    if name == "obstacles":
        return obstacles_of(Path(_unquoted(value)).expanduser())
    if name.lstrip("+") == "task.obstacles" and "file" in value:
        return with_meshes_read(override)
    own_keys = COMMANDS[command].own_keys
    if name == "goal" and name not in own_keys:
        raise BadInputError(
            f"goal: koopdqn {command} goes to the goal that was demonstrated, found {shown(value)}; koopdqn eval takes"
            " another"
        )
    if name in ("start", "host") and name not in own_keys and command not in ("export", "stream"):
        raise BadInputError(f"{name}: koopdqn {command} takes none, found {shown(value)}")
    name = f"{command}.{name}" if name in own_keys else _SHORT_NAMES.get(name, name)
    if name in (*PATH_KEYS, "import.pose") and not (name in ("demos", "correct.waypoints") and _is_list(value)):
        value = _quoted(value)
    return f"{name}{equals}{value}"


def _exists(text: str) -> bool:
    """Return whether there is something of this name; of a text too long for one there is not."""
    with suppress(OSError, ValueError):
        return Path(text).exists()
    return False


def _is_list(value: str) -> bool:
    return value.startswith("[") and value.endswith("]") and not _exists(value)


def _is_path(value: str) -> bool:
    text = _unquoted(value)
    return (
        "/" in text
        or text.lower().endswith(_INTENT_SUFFIXES)
        or text == "~"
        or (_exists(text) and Path(text).is_file())
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
    return _text(value)


def _text(value: str) -> str:
    """Return a text in Hydra's grammar, in quotes where it needs them."""
    plain = _PLAIN_VALUE.fullmatch(value) and not _NUMBER_OR_BOOLEAN.fullmatch(value)
    return value if plain else literal(value)


def literal(value: str) -> str:
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


def _recorded(folder: str, command: str, *, measured: bool = False) -> list[Recorded]:
    what = COMMANDS[command].goes_on_with
    if not folder.strip():
        raise BadInputError(f"run: must name the folder of {what}, found ''")
    recorded = read_record(Path(folder), what)
    commands = [item.value for item in recorded if item.key == "command"]
    # A corrected run is one of the training it was corrected from, less what going on needs.
    corrected = command == "train" and measured and commands[-1:] == ["correct"]
    if commands and commands[-1] != command and not corrected:
        raise BadInputError(f"run: must name a run of {command!r}, found one of {commands[-1]!r} in {folder!r}")
    return recorded
