"""Artifacts: arrays and one canonical JSON text of metadata in one file; nothing in it unpickles."""

import hashlib
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from koopdqn.errors import BadInputError
from koopdqn.files import atomic_path, canonical_json
from koopdqn.settings import TARGET, Settings
from koopdqn.untrusted import check_targets

FORMAT_VERSION = 1
_KEY = "koopdqn"
_SHA = "arrays_sha256"


@dataclass(frozen=True)
class Artifact:
    """What an artifact file holds.

    Attributes:
        kind: what it is: "intent", "policy", "checkpoint".
        arrays: by name.
        about: the metadata: the config that shaped it and the SHA-256 of what it was made from.
    """

    kind: str
    arrays: dict[str, np.ndarray]
    about: dict[str, Any]


def arrays_digest(arrays: Mapping[str, np.ndarray]) -> str:
    """Return the SHA-256 of names, types, shapes and bytes of arrays."""
    sha = hashlib.sha256()
    for name in sorted(arrays):
        values = np.asarray(arrays[name], order="C")
        sha.update(f"{name}\n{values.dtype.str}\n{values.shape}\n".encode())
        sha.update(values.tobytes())
    return sha.hexdigest()


def write_artifact(path: Path, artifact: Artifact) -> None:
    """Write an artifact whole or not at all: NumPy's npz or safetensors, by the path's suffix.

    The same content gives the same bytes.
    """
    # Not np.ascontiguousarray, which makes an array of one element out of a scalar.
    arrays = {name: np.asarray(values, order="C") for name, values in artifact.arrays.items()}
    text = canonical_json(
        {"kind": artifact.kind, "format_version": FORMAT_VERSION, _SHA: arrays_digest(arrays), "about": artifact.about}
    )
    with atomic_path(path) as temporary:
        if path.suffix == ".npz":
            with temporary.open("wb") as file:
                np.savez(file, allow_pickle=False, **{_KEY: np.array(text)}, **arrays)
        else:
            from safetensors.numpy import save

            # One key only: safetensors writes several in random order. Written here, since a full disk is an
            # OSError of Python's but an error of its own of safetensors'.
            temporary.write_bytes(save(arrays, metadata={_KEY: text}))


def read_artifact(path: Path, kind: str) -> Artifact:
    """Read an artifact.

    Raises:
        BadInputError: the file is missing, truncated, of another kind or format, was changed by hand, or names a
            class that it may not (:mod:`koopdqn.untrusted`).
    """
    what = f"{kind} file {path}"
    if not path.is_file():
        raise BadInputError(f"{what} must exist, found {'a folder' if path.is_dir() else 'nothing'} there")
    try:
        text, arrays = _read_npz(path) if path.suffix == ".npz" else _read_safetensors(path)
        header = json.loads(text)
        found, version, sha, about = header["kind"], header["format_version"], header[_SHA], header["about"]
    except BadInputError:
        raise
    # safetensors' own error derives from Exception alone.
    except Exception as error:
        raise BadInputError(f"{what} must be a whole artifact written by koopdqn, found: {error!r}") from error
    if found != kind:
        raise BadInputError(f"{what} must be of kind {kind}, found kind {found}")
    if version != FORMAT_VERSION:
        raise BadInputError(f"{what} must have format version {FORMAT_VERSION}, found {version}")
    if sha != arrays_digest(arrays):
        raise BadInputError(f"{what} must hold the arrays it was written with, found others: it was changed by hand")
    check_targets(about, what)
    return Artifact(kind, arrays, about)


def _read_npz(path: Path) -> tuple[str, dict[str, np.ndarray]]:
    if not zipfile.is_zipfile(path):
        raise BadInputError(f"{path} must be an npz file, found something else or a truncated one")
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    return str(arrays.pop(_KEY)), arrays


def _read_safetensors(path: Path) -> tuple[str, dict[str, np.ndarray]]:
    from safetensors import safe_open

    with safe_open(path, framework="numpy") as file:
        metadata = file.metadata() or {}
        return metadata[_KEY], {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)


def check_task(what: str, found: Any, task: Settings) -> None:
    """Raise unless a file's metadata of its task, ``found``, is that of a task.

    Raises:
        BadInputError: it is not; the keys that differ are named. ``what`` names the file.
    """
    wanted = described(task)
    if found == wanted:
        return
    known = found if isinstance(found, dict) else {}
    differing = sorted(key for key in wanted.keys() | known.keys() if known.get(key) != wanted.get(key))
    raise BadInputError(
        f"{what} must be of task {wanted['name']} with the present settings, found task {known.get('name', found)}"
        f" (differing: {', '.join(differing)})"
    )


def described(settings: Settings) -> dict[str, Any]:
    """Return settings as JSON values that :func:`koopdqn.settings.load_settings` turns back into them."""
    cls = type(settings)
    node: dict[str, Any] = {TARGET: f"{cls.__module__}.{cls.__qualname__}"}
    for name, field in cls.model_fields.items():
        value = getattr(settings, name)
        node[name] = _plain(value)
        # Only where a subclass may stand is its name read; elsewhere it would be an unknown key.
        if type(value) is field.annotation and isinstance(value, Settings):
            del node[name][TARGET]
    return node


def _plain(value: Any) -> Any:
    if isinstance(value, list | tuple):
        plain = [_plain(item) for item in value]
        for node, item in zip(plain, value, strict=True):
            if isinstance(item, Settings):
                del node[TARGET]
        return plain
    if isinstance(value, Settings):
        return described(value)
    return str(value) if isinstance(value, Path) else value
