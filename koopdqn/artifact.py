"""Artifacts: arrays and one canonical JSON text of metadata in one file; nothing in it unpickles."""

import hashlib
import math
import os
import struct
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from koopdqn.errors import BadInputError, KoopdqnError
from koopdqn.files import LARGEST_JSON, atomic_path, canonical_json, parse_json
from koopdqn.settings import TARGET, Settings, shown
from koopdqn.untrusted import check_names_no_file, check_targets

FORMAT_VERSION = 1
_KEY = "koopdqn"
_FEW = 3
"""So many keys that differ are told with their values."""
_DIGEST = 64
"""Characters of a text that says nothing to a person."""
_SHA = "arrays_sha256"
_MOST_ARRAYS = 1000
# The record that ends a zip file, and how much before it another kind of it may stand.
_ZIP_END = struct.Struct("<4s4H2LH")
_ZIP_TAIL = _ZIP_END.size + 20


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


def below(arrays: Mapping[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """Return the arrays whose names begin with a prefix, without it."""
    return {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}


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
    """Read an artifact; its sizes are checked before anything is read.

    Raises:
        BadInputError: the file is missing, truncated, of another kind or format, was changed by hand, is larger than
            a quarter of this machine's memory, or names a class that it may not (:mod:`koopdqn.untrusted`).
    """
    what = f"{kind} file {path}"
    if not path.is_file():
        raise BadInputError(f"{what} must exist, found {'a folder' if path.is_dir() else 'nothing'} there")
    with reading(what):
        size, most = path.stat().st_size, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 4
        if size > most:
            raise BadInputError(
                f"{what} must hold at most {most} bytes, a quarter of this machine's memory, found {size}"
            )
        text, arrays = _read_npz(path) if path.suffix == ".npz" else _read_safetensors(path)
        header = parse_json(text)
        found, version, sha, about = header["kind"], header["format_version"], header[_SHA], header["about"]
        if not isinstance(about, dict):
            raise ValueError(f"about must be an object, found {shown(about)}")
    if found != kind:
        raise BadInputError(f"{what} must be of kind {kind}, found kind {_brief(found)}")
    if version is True or version != FORMAT_VERSION:
        raise BadInputError(f"{what} must have format version {FORMAT_VERSION}, found {_brief(version)}")
    if sha != arrays_digest(arrays):
        raise BadInputError(f"{what} must hold the arrays it was written with, found others: it was changed by hand")
    check_targets(about, what)
    check_names_no_file(about, what)
    return Artifact(kind, arrays, about)


@contextmanager
def reading(what: str) -> Iterator[None]:
    """Turn whatever a block raises over a file's content into one line that names the file.

    Args:
        what: names the file, for the message.

    Raises:
        BadInputError: the block raised something that is no error of koopdqn's own.
    """
    try:
        yield
    except KoopdqnError:
        raise
    except OSError as error:
        raise BadInputError(f"{what} must be readable, the system says: {error.strerror or error}") from error
    # safetensors' own error derives from Exception alone, and odd content raises anything
    except Exception as error:
        raise BadInputError(f"{what} must be a whole artifact written by koopdqn, found: {shown(error)}") from error


def _brief(value: Any) -> str:
    return value if isinstance(value, str) and value.isidentifier() and len(value) < 40 else shown(value)


def _read_npz(path: Path) -> tuple[str, dict[str, np.ndarray]]:
    _check_directory(path)
    arrays = {}
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            # As np.savez writes them, so that nothing read is larger than the file.
            if entry.compress_type != zipfile.ZIP_STORED or entry.file_size > path.stat().st_size:
                raise ValueError(f"arrays must not be compressed, found {entry.filename!r} so")
            name = entry.filename.removesuffix(".npy")
            if name in arrays:
                raise ValueError(f"names must differ, found two arrays {name!r}")
            arrays[name] = _array(archive.read(entry))
    return str(arrays.pop(_KEY)), arrays


def _check_directory(path: Path) -> None:
    """Raise unless a zip file ends as np.savez ends it, with a directory of few entries."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - _ZIP_TAIL, 0))
        tail = file.read()
    end = tail[-_ZIP_END.size :]
    if len(end) < _ZIP_END.size or not end.startswith(b"PK\5\6"):
        raise BadInputError(f"{path} must be an npz file, found something else or a truncated one")
    _, _, _, here, total, size, _, comment = _ZIP_END.unpack(end)
    if b"PK\6\7" in tail or comment or not here == total <= _MOST_ARRAYS or size > _MOST_ARRAYS * 1000:
        raise ValueError(f"must hold at most {_MOST_ARRAYS} arrays and no comment, found {total} and {comment} bytes")


def _array(content: bytes) -> np.ndarray:
    """Return the array of a npy file, of numbers, booleans or text, once its size is known to be the file's."""
    file = BytesIO(content)
    if np.lib.format.read_magic(file) == (1, 0):
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
    else:
        shape, fortran, dtype = np.lib.format.read_array_header_2_0(file)
    begin = file.tell()
    if dtype.hasobject or dtype.kind not in "biufU" or not dtype.itemsize or fortran:
        raise ValueError(f"arrays must be of numbers, booleans or text, row by row, found {dtype}")
    if math.prod(shape) * dtype.itemsize != len(content) - begin:
        raise ValueError(f"an array must have the bytes that its shape needs, found {shape} and {len(content) - begin}")
    return np.frombuffer(content, dtype, offset=begin).reshape(shape).copy()


def _read_safetensors(path: Path) -> tuple[str, dict[str, np.ndarray]]:
    from safetensors import safe_open

    with path.open("rb") as head:
        length = int.from_bytes(head.read(8), "little")
    if length > LARGEST_JSON:
        raise ValueError(f"the header must hold at most {LARGEST_JSON} bytes, found {length}")
    with safe_open(path, framework="numpy") as file:
        metadata = file.metadata() or {}
        return metadata[_KEY], {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)


def check_task(what: str, found: Any, task: Settings) -> None:
    """Raise unless a file's metadata of its task, ``found``, is that of a task.

    Raises:
        BadInputError: it is not; the keys that differ are named, with both values. ``what`` names the file.
    """
    wanted = described(task)
    if found == wanted:
        return
    known = found if isinstance(found, dict) else {}
    if known.get("name", wanted["name"]) != wanted["name"]:
        raise BadInputError(f"{what} must be of task {wanted['name']}, found task {known['name']}")
    differing = sorted(key for key in wanted.keys() | known.keys() if known.get(key) != wanted.get(key))
    raise BadInputError(
        f"{what} must be of task {wanted['name']} with the present settings, found task {known.get('name', found)}"
        f" (differing: {', '.join(_both(key, known, wanted) if len(differing) <= _FEW else key for key in differing)})"
    )


def _both(key: str, known: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """Return a key with both of its values, where they are single ones that a person can read."""
    there, here = known.get(key), wanted.get(key)
    plain = all(isinstance(each, bool | int | float | str) and len(str(each)) < _DIGEST for each in (there, here))
    return f"{key}, {shown(there)} there and {shown(here)} here" if plain else key


def described(settings: Settings) -> dict[str, Any]:
    """Return settings as JSON values that :func:`koopdqn.settings.load_settings` turns back into them.

    Fields that are excluded, such as a path on this machine, are left out.
    """
    cls = type(settings)
    node: dict[str, Any] = {TARGET: f"{cls.__module__}.{cls.__qualname__}"}
    for name, field in cls.model_fields.items():
        if field.exclude:
            continue
        value = getattr(settings, name)
        if not field.is_required() and not field.default and value == field.default:
            # An absent optional part: files written before it existed say the same.
            continue
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
