"""Files that appear whole or not at all, and JSON that is the same bytes for the same content."""

import errno
import hashlib
import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from koopdqn.errors import BadInputError, WorkFailedError


class DivergedError(WorkFailedError, ValueError):
    """A result that must be a finite number is none: the numbers of the computation have diverged."""


OUT_OF_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.ENOMEM, errno.EMFILE, errno.ENFILE)
"""Errors of the operating system by which good input comes to nothing."""

LARGEST_JSON = 2**26
"""The most bytes that a JSON text may hold."""
DEEPEST_JSON = 64
"""How deep it may be nested."""


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that replaces it when the block ends well.

    Raises:
        BadInputError: the folder cannot be written.
        WorkFailedError: the disk is full or broken.
    """
    temporary = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # What lies there is left of a process that was killed, or a link that leads elsewhere.
        temporary.unlink(missing_ok=True)
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        kind = WorkFailedError if error.errno in OUT_OF_ROOM else BadInputError
        raise kind(f"{path} must be writable, the system says: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, content: Any) -> None:
    """Write a JSON file for people: sorted keys, indented.

    Raises:
        DivergedError: a number is NaN or infinite.
    """
    _require_finite(content, path.name)
    write_text(path, json.dumps(content, indent=2, sort_keys=True, allow_nan=False) + "\n")


def canonical_json(content: Any) -> str:
    """Return the one JSON text of a content: sorted keys, no spaces.

    Raises:
        DivergedError: a number is NaN or infinite.
    """
    _require_finite(content, "")
    return json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=True)


def _require_finite(content: Any, where: str) -> None:
    """Raise unless every number is finite: settings have none that is not, so the computation has diverged."""
    if isinstance(content, float) and not math.isfinite(content):
        name = where or "a result"
        raise DivergedError(f"{name}: must be JSON compliant, so finite, found {content}: the numbers diverged")
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in items:
        _require_finite(value, f"{where}.{key}".removeprefix("."))


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest(content: Any) -> str:
    """Return the SHA-256 of the canonical JSON of a content."""
    return hashlib.sha256(canonical_json(content).encode()).hexdigest()


def parse_json(text: str | bytes) -> Any:
    """Return the content of a JSON text.

    Raises:
        ValueError: it is no JSON, is too long or nested too deep, or holds NaN, infinity or a number beyond them.
    """
    if len(text) > LARGEST_JSON:
        raise ValueError(f"must hold at most {LARGEST_JSON} bytes, found {len(text)}")
    try:
        content = json.loads(text)
    except RecursionError as error:
        raise ValueError(f"must be nested at most {DEEPEST_JSON} deep, found deeper") from error
    waiting = [(content, 1)]
    while waiting:
        node, depth = waiting.pop()
        if depth > DEEPEST_JSON:
            raise ValueError(f"must be nested at most {DEEPEST_JSON} deep, found deeper")
        for value in node.values() if isinstance(node, dict) else node if isinstance(node, list) else [node]:
            if isinstance(value, dict | list):
                waiting.append((value, depth + 1))
            elif isinstance(value, float) and not math.isfinite(value):
                raise ValueError(f"numbers must be finite, found {value}")
    return content


def read_json(path: Path, what: str) -> Any:
    """Read a JSON file.

    Raises:
        BadInputError: the file is missing, too large or no JSON (:func:`parse_json`); ``what`` names it for the user.
    """
    try:
        if path.stat().st_size > LARGEST_JSON:
            raise ValueError(f"must hold at most {LARGEST_JSON} bytes, found {path.stat().st_size}")
        return parse_json(path.read_bytes())
    except OSError as error:
        raise BadInputError(f"{what} must be a readable file, found {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise BadInputError(f"{what} must hold JSON, found {path}: {error}") from error
