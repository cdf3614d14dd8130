"""Completion of overrides in the shell: config groups, their options, keys and files."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from koopdqn.app.hydra.compose import composed
from koopdqn.app.hydra.overrides import FILE_KEYS, literal
from koopdqn.resources import conf_dir

if TYPE_CHECKING:
    from omegaconf import DictConfig


def complete(words: Sequence[str], incomplete: str, config_dir: str | None = None) -> list[str]:
    """Return what may stand in place of ``incomplete``; nothing, rather than an error, if anything fails.

    Bash splits words at ``=`` and asks for the part behind it only; other shells give whole words. Both
    are understood. ``words`` are the overrides already typed, ``config_dir`` is the user's own config folder.
    """
    try:
        typed = _rejoined(words)
        key = typed.pop().removesuffix("=") if typed and _is_open(typed[-1]) else None
        start = incomplete if key is None else f"{key}={incomplete}"
        found = sorted({item for item in _candidates(typed, start, config_dir) if item.startswith(start)})
        return found if key is None else [item[len(key) + 1 :] for item in found]
    # completion runs inside the user's prompt: whatever is wrong, it must stay silent
    except Exception:
        return []


def _rejoined(words: Sequence[str]) -> list[str]:
    """Undo bash's split: ``["task", "=", "shelf"]`` is ``["task=shelf"]``."""
    joined: list[str] = []
    for word in words:
        if joined and (word == "=" or joined[-1].endswith("=")):
            joined[-1] += word
        else:
            joined.append(word)
    return joined


def _is_open(word: str) -> bool:
    return word.endswith("=") or ("=" not in word and not word.startswith("~"))


def _candidates(typed: Sequence[str], start: str, config_dir: str | None) -> Iterator[str]:
    from omegaconf import OmegaConf

    prefix = start[: len(start) - len(start.lstrip("+~"))]
    key, equals, value = start.removeprefix(prefix).partition("=")
    if equals and key in FILE_KEYS:
        yield from (f"{prefix}{key}={path}" for path in _paths(value))
    user_dir = Path(config_dir).absolute() if config_dir else None
    for folder in (conf_dir(), user_dir):
        options = folder.glob("*/*.yaml") if folder else ()
        yield from (f"{prefix}{each.parent.name}={each.stem}" for each in options if each.parent.name != "hydra")
    if not prefix.startswith("~"):
        content = OmegaConf.to_container(_composed(typed, user_dir), resolve=False)
        yield from (prefix + item for item in _leaves(content, "", nested="." in key))


def _composed(typed: Sequence[str], user_dir: Path | None) -> "DictConfig":
    search = [f"hydra.searchpath=[{literal(f'file://{user_dir}')}]"] if user_dir else []
    try:
        return composed([*search, *typed])
    # an override still being typed, or wrong, must not take the completion of the others away
    except Exception:
        return composed([])


def _leaves(content: Any, parent: str, *, nested: bool) -> Iterator[str]:
    """Yield ``key=current value`` of each leaf; below the top level only when a dot has been typed."""
    for name, value in content.items():
        if isinstance(value, Mapping):
            if nested:
                yield from _leaves(value, f"{parent}{name}.", nested=True)
        else:
            yield f"{parent}{name}={_as_typed(value)}"


def _as_typed(value: object) -> str:
    if value is None or value == "???" or isinstance(value, list):
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    text = str(value)
    return "" if " " in text or "${" in text else text


def _paths(value: str) -> Iterator[str]:
    folder, _, start = value.rpartition("/")
    shown = f"{folder}/" if folder or value.startswith("/") else ""
    for entry in Path(shown or ".").expanduser().iterdir():
        if entry.name.startswith(start) and (start or not entry.name.startswith(".")):
            yield f"{shown}{entry.name}{'/' if entry.is_dir() else ''}"
