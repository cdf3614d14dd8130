"""Recordings as arrays: NumPy's npy and npz, and MATLAB's mat. Nothing is unpickled."""

import zipfile
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np

from koopdqn.demonstrations.recordings.recording import ImportSettings, Recording
from koopdqn.demonstrations.recordings.tree import Tree, check_size, recordings_of_tree
from koopdqn.errors import BadInputError
from koopdqn.pose import Array

_NPY: Final = b"\x93NUMPY"
PICKLED: Final = "is a pickle, which can run any program when it is read; save numbers as CSV, npy or npz instead"


def read_numpy(path: Path, declared: ImportSettings) -> list[Recording]:
    """Return the recordings of an npy or npz file: arrays (N, k), (D, N, k) or (N, 4, 4), named or not.

    Raises:
        BadInputError: the file is damaged, too large, or holds a pickle.
    """
    tree: dict[str, Array | Tree] = {}
    try:
        with path.open("rb") as file:
            if file.read(len(_NPY)) == _NPY:
                file.seek(0)
                tree[""] = _array(path, path.stem, file)
        if not tree:
            with zipfile.ZipFile(path) as archive:
                check_size(path, sum(each.file_size for each in archive.infolist()))
                for each in archive.infolist():
                    with archive.open(each) as member:
                        tree[each.filename.removesuffix(".npy")] = _array(path, each.filename, member)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, RuntimeError) as error:
        raise BadInputError(f"demos {path}: must be an intact npy or npz file, found: {error}") from error
    plain = {name: value for name, value in tree.items() if isinstance(value, np.ndarray)}
    # Arrays with fields are logs of something else where there are others that can be poses.
    kept: Tree = plain if any(value.ndim > 1 for value in plain.values()) else tree
    return recordings_of_tree(str(path), kept, declared, Recording(str(path), reasons=("NumPy arrays",)))


def _array(path: Path, name: str, file: Any) -> Array | Tree:
    """Return one array, after its header was found to be of numbers and not too large; by field if it has fields."""
    version = np.lib.format.read_magic(file)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read_header(file)
    if dtype.hasobject:
        raise BadInputError(f"demos {path}: array {name} {PICKLED}")
    fields = dtype.fields if len(shape) == 1 else None
    if not fields and (dtype.kind not in "fiub" or len(shape) not in (0, 1, 2, 3)):
        return np.zeros(0)
    count = int(np.prod(shape, dtype=object))
    # As they are read, numbers of one byte take eight.
    check_size(path, max(8, dtype.itemsize) * count)
    content = file.read(count * dtype.itemsize)
    values = np.frombuffer(content, dtype=dtype, count=count)
    if fields:
        kinds = {field: kind.base.kind for field, (kind, *_) in fields.items()}
        return {field: values[field].astype(float) for field, kind in kinds.items() if kind in "fiub"}
    shaped = values.reshape(shape[::-1]).T if fortran else values.reshape(shape)
    return shaped.astype(float)


def read_matlab(path: Path, declared: ImportSettings) -> list[Recording]:
    """Return the recordings of a MATLAB file: matrices, structures of them, and cells of demonstrations.

    Raises:
        BadInputError: the file is damaged or too large.
    """
    import scipy.io

    try:
        # The sizes of all that is in it, before any of it is read.
        sizes = [int(np.prod(shape, dtype=object)) for _, shape, _ in scipy.io.whosmat(path)]
        check_size(path, 8 * sum(sizes))
        with path.open("rb") as file:
            _check_inflated(path, file)
        content = scipy.io.loadmat(path, simplify_cells=True)
    except BadInputError:
        raise
    # SciPy's reader raises whatever a damaged file leads it to.
    except Exception as error:
        raise BadInputError(f"demos {path}: must be an intact MATLAB file, found: {error}") from error
    tree = {name: _tree_of(value) for name, value in content.items() if not name.startswith("__")}
    kept = {name: value for name, value in tree.items() if value is not None}
    return recordings_of_tree(str(path), kept, declared, Recording(str(path), reasons=("MATLAB variables",)))


def _check_inflated(path: Path, file: BinaryIO) -> None:
    """Check what the compressed parts of a MATLAB file come to, without keeping it."""
    import zlib

    file.seek(126)
    order: Any = "little" if file.read(2) == b"IM" else "big"
    total = 0
    while len(tag := file.read(8)) == 8:
        kind, size = (int.from_bytes(tag[i : i + 4], order) for i in (0, 4))
        if kind != 15:
            file.seek(size, 1)
            total += size
            continue
        inflate, left = zlib.decompressobj(), size
        while left > 0 and (part := file.read(min(left, 1 << 16))):
            left -= len(part)
            while part:
                total += len(inflate.decompress(part, 1 << 20))
                part = inflate.unconsumed_tail
                check_size(path, total)


def _tree_of(value: Any) -> Tree | Array | None:
    if isinstance(value, dict):
        parts = {name: _tree_of(each) for name, each in value.items() if not name.startswith("__")}
        return {name: each for name, each in parts.items() if each is not None}
    if isinstance(value, np.ndarray) and value.dtype == object:
        value = list(value.ravel())
    if isinstance(value, list):
        return _tree_of({f"demo_{index}": each for index, each in enumerate(value)})
    found = np.asarray(value)
    return np.atleast_1d(found).astype(float) if found.dtype.kind in "fiub" else None
