"""What a file of unknown origin may name: classes of koopdqn, and of modules that the user has named."""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Final

from koopdqn.errors import BadInputError

TARGET: Final = "target"
"""The key that names a class, in a config and in an artifact's metadata."""

_OWN: Final = "koopdqn"
_DOTTED: Final = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)+", re.ASCII)
_trusted: ContextVar[tuple[str, ...]] = ContextVar("trusted modules", default=())


@contextmanager
def trusting(modules: Sequence[str]) -> Iterator[None]:
    """Let files that are read in the block name classes of some modules, and of modules below them.

    Args:
        modules: dotted names, such as ``my_lab.tasks``.

    Raises:
        BadInputError: they are one text, not several.
    """
    if isinstance(modules, str):
        raise BadInputError(f"modules: must be a list of dotted names, found {modules!r}")
    token = _trusted.set((*_trusted.get(), *modules))
    try:
        yield
    finally:
        _trusted.reset(token)


def check_target(target: object, what: str, modules: Sequence[str] = ()) -> None:
    """Raise unless a class may be named by a file; nothing is imported to find out.

    Args:
        target: the dotted name found.
        what: names the file and the key, for the message.
        modules: trusted besides those of :func:`trusting`.

    Raises:
        BadInputError: it is no dotted name, or of a module that the user has not named.
    """
    allowed = (_OWN, *_trusted.get(), *modules)
    if isinstance(target, str) and _DOTTED.fullmatch(target) and any(target.startswith(f"{m}.") for m in allowed):
        return
    shown = " ".join(repr(target).split())
    module = str(target).rpartition(".")[0]
    hint = ""
    if _DOTTED.fullmatch(str(target)):
        hint = (
            f"; if you trust that module, add trust_modules={module}, or from Python read it within"
            f" koopdqn.untrusted.trusting([{module!r}])"
        )
    raise BadInputError(f"{what} must name a class of koopdqn, found {shown[:80]}{hint}")


def check_targets(node: Any, what: str) -> None:
    """Raise unless every class that a file's JSON content names may be named by it (:func:`check_target`)."""
    for key, target in targets(node):
        check_target(target, f"{what}: {key}")


FILES: Final = ("path", "file")
"""Keys that name a file, in a config."""


def check_names_no_file(node: Any, what: str) -> None:
    """Raise where a file's JSON content names another file, which would be read."""
    for key, value in _named(node, FILES):
        if value is not None:
            raise BadInputError(f"{what}: {key} must name no file, found {' '.join(repr(value).split())[:80]}")


def targets(node: Any) -> Iterator[tuple[str, Any]]:
    """Yield the dotted key and the value of every ``target`` in nested mappings and lists."""
    return _named(node, (TARGET,))


def _named(node: Any, names: Sequence[str], key: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(node, Mapping):
        for name, value in node.items():
            inner = f"{key}.{name}" if key else str(name)
            if name in names:
                yield inner, value
            yield from _named(value, names, inner)
    elif isinstance(node, list | tuple):
        for index, value in enumerate(node):
            yield from _named(value, names, f"{key}[{index}]")


def modules_named(node: Any) -> list[str]:
    """Return the modules of the classes that every ``target`` in nested mappings and lists names."""
    return [str(target).rpartition(".")[0] for _, target in targets(node)]
