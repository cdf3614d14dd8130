"""What a run folder says it was begun with, read as data: values of koopdqn's own keys and nothing else."""

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from koopdqn.errors import BadInputError, unknown_name
from koopdqn.resources import check_asset
from koopdqn.run_folder import RECORD, check_plain
from koopdqn.settings import shown
from koopdqn.untrusted import FILES, TARGET, check_target

GROUPS: Final = ("task", "person", "intent", "trust", "oracle", "agent", "robot", "actions", "preset")
"""The config groups."""
SECTIONS: Final = (
    *("import", "inspect", "demo", "fit", "reward", "feedback", "train", "eval", "report"),
    *("export", "program", "stream", "guard", "view", "explain", "compare", "correct"),
)
"""The root's keys that hold keys."""
VALUES: Final = ("command", "seed", "out", "run", "demos", "intent_file", "trust_modules")
"""The root's keys that hold values."""
PATH_NAMES: Final = (
    *("out", "run", "demos", "intent_file", "journal", "questions", "answers"),
    *("runs", "sweep", "video", "path", "file"),
)
"""The last part of every key whose value is a path."""

# What says where this run lies and whom its user trusts is for the present command line to say.
_OF_THE_COMMAND: Final = (
    *("command", "out", "run", "trust_modules", "inspect", "report", "export", "program", "stream", "guard"),
    *("view", "explain", "compare", "correct"),
)
_LARGEST: Final = 64 * 1024
_MOST: Final = 1000
_NAME: Final = re.compile(r"[A-Za-z]\w*", re.ASCII)
_OVERRIDE: Final = re.compile(r"(\+\+|\+|~)?[A-Za-z][\w.]*(=.*)?", re.ASCII | re.DOTALL)
_OPTION: Final = re.compile(r"(?!.*\.\.)\w[\w.-]*")
_REFERENCE: Final = re.compile(rf"\$\{{(per_task:|({'|'.join((*GROUPS, *SECTIONS, 'seed'))})[\w.]*\}})", re.ASCII)


@dataclass(frozen=True)
class Recorded:
    """One recorded override.

    Attributes:
        text: in Hydra's grammar.
        key: what it sets, without prefix.
        value: to what: texts, numbers, booleans, None, and lists and mappings of them.
    """

    text: str
    key: str
    value: Any

    @property
    def name(self) -> str:
        """The key with its prefix."""
        return self.text.partition("=")[0]

    @property
    def root(self) -> str:
        """The first part of the key."""
        return self.key.partition(".")[0]


def read_record(folder: Path, what: str) -> list[Recorded]:
    """Return the overrides that a run folder was begun with; messages say of ``what`` it must be ("a training run").

    Raises:
        BadInputError: the folder holds links, there is no record, it is no plain list of overrides, or one of them is
            not a value of a key of koopdqn's.
    """
    path = folder / RECORD
    if not folder.is_dir():
        found = "a file" if folder.exists() else "no folder"
        raise BadInputError(f"run: must name the folder of {what}, found {found} {str(folder)!r}")
    check_plain(folder)
    if not path.is_file():
        jobs = sorted(each.parent.parent.name for each in folder.glob(f"*/{RECORD}"))
        hint = f"; it is a sweep's, whose runs are {', '.join(jobs)}" if jobs else ""
        raise BadInputError(f"run: must name the folder of {what}, found no {RECORD} in {str(folder)!r}{hint}")
    if not path.stat().st_size:
        raise BadInputError(
            f"run: {str(folder)!r} must hold what it was begun with, found it stopped before it had begun"
        )
    return [_parsed(text, path) for text in _texts(path)]


def check_record(
    recorded: Iterable[Recorded], folder: Path, trusted: Sequence[str], replaced: Collection[str]
) -> list[str]:
    """Return recorded overrides that are safe to apply, in Hydra's grammar.

    Those that are for the present command to say are left out.

    Args:
        recorded: the overrides.
        folder: the run folder; the paths of a record must lie in it.
        trusted: modules that classes may be of besides koopdqn's own.
        replaced: keys that the command line gives anew; recorded values of these are left out.

    Raises:
        BadInputError: an override names a class of another module, or a path outside the folder.
    """
    kept = []
    for item in _that_hold(recorded, replaced):
        for key, value in _leaves(item.key, item.value):
            _check_leaf(key, value, folder, trusted, item.key)
        kept.append(item.text)
    return kept


def said_again(recorded: Iterable[Recorded], replaced: Collection[str]) -> list[str]:
    """Return the recorded overrides that a command line has to say again, since :func:`check_record` refuses them.

    They are paths, which may lie elsewhere, but for the keys ``replaced``, and modules of classes not koopdqn's.
    """
    said, modules = [], set()
    for item in _that_hold(recorded, replaced):
        leaves = [(key.rpartition(".")[2], value) for key, value in _leaves(item.key, item.value)]
        modules |= {str(value).rpartition(".")[0] for last, value in leaves if last == TARGET}
        if any(_is_path(last, value) for last, value in leaves):
            said.append(item.text)
    own = sorted(module for module in modules if module.partition(".")[0] != "koopdqn")
    return [*said, *([f"trust_modules=[{','.join(own)}]"] if own else [])]


def _is_path(last: str, value: Any) -> bool:
    """Return whether a key whose last part is ``last`` holds a path: ``eval.video`` says whether there is to be one."""
    return last in PATH_NAMES and value is not None and not isinstance(value, bool)


def _that_hold(recorded: Iterable[Recorded], replaced: Collection[str]) -> list[Recorded]:
    return [item for item in recorded if item.root not in _OF_THE_COMMAND and item.key not in replaced]


def _texts(path: Path) -> list[str]:
    import yaml

    size = path.stat().st_size
    if size > _LARGEST:
        raise BadInputError(f"run: {path} must hold at most {_LARGEST} bytes, found {size}")
    try:
        text = path.read_text(encoding="utf-8")
        # This loader knows no tags and makes texts, lists and mappings alone.
        found = yaml.load(text, Loader=yaml.BaseLoader)
    # the file may hold anything, and the YAML parser has errors of its own
    except Exception as error:
        raise BadInputError(f"run: {path} cannot be read ({type(error).__name__})") from error
    if not isinstance(found, list) or len(found) > _MOST or not all(isinstance(each, str) for each in found):
        raise BadInputError(f"run: {path} must be a list of at most {_MOST} overrides, found {shown(text)}")
    return found


def _parsed(text: str, path: Path) -> Recorded:
    from hydra.core.override_parser.overrides_parser import OverridesParser

    # Anything else Hydra might take for one of its options.
    if not _OVERRIDE.fullmatch(text) or ("=" not in text and not text.startswith("~")):
        raise BadInputError(f"run: {path} must be a list of overrides key=value of koopdqn's keys, found {shown(text)}")
    key = text.partition("=")[0].lstrip("+~")
    known = (*GROUPS, *SECTIONS, *VALUES)
    if key.partition(".")[0] not in known:
        raise unknown_name("key", key, known)
    try:
        parsed = OverridesParser.create().parse_override(text)
        value = parsed.value()
    # deep nesting ends in an error of Python's
    except Exception as error:
        raise BadInputError(f"run: {path}: {shown(text)} cannot be read ({type(error).__name__})") from error
    if parsed.key_or_group != key or parsed.package is not None or parsed.is_sweep_override():
        raise BadInputError(f"run: {path} must give every key one value, found {shown(text)}")
    if key in GROUPS and not isinstance(value, Mapping):
        options = value if isinstance(value, list) else [value]
        if not all(option is None or (isinstance(option, str) and _OPTION.fullmatch(option)) for option in options):
            raise BadInputError(f"run: {path}: {key} must name an option of the config, found {shown(value)}")
    return Recorded(text, key, value)


def _leaves(key: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield every value in a nested one with its dotted key; the items of a list go by the list's."""
    if isinstance(value, Mapping):
        for name, inner in value.items():
            yield from _leaves(f"{key}.{name}", inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _leaves(key, inner)
    else:
        yield key, value


def _check_leaf(key: str, value: Any, folder: Path, trusted: Sequence[str], given: str) -> None:
    record = folder / RECORD
    *_, last = parts = key.split(".")
    odd = [part for part in parts if not _NAME.fullmatch(part)]
    if odd:
        raise BadInputError(f"run: {record}: {key} must consist of names, found {shown(odd[0])}")
    if last == TARGET:
        check_target(value, f"run: {record}: {key}", trusted)
    elif last == "asset":
        check_asset(str(value))
    elif last in FILES and value is not None:
        # Of an arm or a mesh: it may name others in turn.
        raise BadInputError(
            f"run: {record}: {key} is never taken from a run folder, found {shown(value)}; give {given}= again"
        )
    elif _is_path(last, value):
        _check_path(key, value, folder, given)
    elif isinstance(value, str):
        for found in re.finditer(r"\$\{", value):
            if not _REFERENCE.match(value, found.start()):
                raise BadInputError(f"run: {record}: {key} may refer to koopdqn's own keys, found {shown(value)}")


def _check_path(key: str, value: Any, folder: Path, given: str) -> None:
    own = folder.resolve()
    # A reference is resolved only later, and a home folder lies elsewhere.
    plain = isinstance(value, str) and "${" not in value and "\0" not in value and not value.startswith("~")
    if not plain or not Path(value).resolve().is_relative_to(own):
        raise BadInputError(
            f"run: {folder / RECORD}: {key} must lie in the run folder, found {shown(value)};"
            f" give {given}= again if it is still to be read or written"
        )
