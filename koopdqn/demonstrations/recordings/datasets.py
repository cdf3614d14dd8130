"""Recordings as data sets: HDF5 (robomimic's and others), MATLAB 7.3, and LeRobot's Parquet."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np

from koopdqn.demonstrations.recordings.columns import recordings_of
from koopdqn.demonstrations.recordings.recording import ArrayColumns, ImportSettings, Recording
from koopdqn.demonstrations.recordings.tree import check_size, recordings_of_tree
from koopdqn.errors import BadInputError

_STATE: Final = "observation.state"
INFO: Final = Path("meta") / "info.json"
"""What tells of a LeRobot data set, below its folder."""
_LARGEST_INFO: Final = 1 << 24


def read_hdf5(path: Path, declared: ImportSettings) -> list[Recording]:
    """Return the recordings of an HDF5 file: robomimic's layout, or any groups of arrays.

    Raises:
        BadInputError: the file is damaged or too large.
    """
    try:
        with h5py.File(path, "r") as file:
            check_size(path, _bytes_of(file))
            tree, stated = _tree_of(file), _stated(path, file)
    except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
        raise BadInputError(f"demos {path}: must be an intact HDF5 file, found: {error}") from error
    return recordings_of_tree(str(path), tree, declared, stated)


def _bytes_of(file: h5py.File) -> int:
    total = 0

    def add(_: str, each: Any) -> None:
        nonlocal total
        if isinstance(each, h5py.Dataset) and _is_numbers(each):
            total += 8 * int(np.prod(each.shape, dtype=object))

    file.visititems(add)
    return total


def _is_numbers(each: h5py.Dataset) -> bool:
    # Pictures have four axes; only what may be rows of numbers is read.
    return each.dtype.kind in "fiu" and each.ndim in (1, 2, 3) and each.external is None and not each.is_virtual


def _tree_of(group: h5py.Group) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for name in group:
        # A link may lead to another file; those are left alone.
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            continue
        each = group[name]
        if isinstance(each, h5py.Group):
            tree[name] = _tree_of(each)
        elif _is_numbers(each):
            tree[name] = np.asarray(each, dtype=float)
    return tree


def _stated(path: Path, file: h5py.File) -> Recording:
    """Return what robomimic's attributes say."""
    data = file.get("data")
    stated = Recording(str(path), reasons=("HDF5",))
    if not isinstance(data, h5py.Group) or "env_args" not in data.attrs:
        return stated
    try:
        about = json.loads(data.attrs["env_args"])
        rate = about.get("env_kwargs", {}).get("control_freq")
    except (TypeError, ValueError, AttributeError):
        return stated
    stated = replace(stated, reasons=("a robomimic data set, by data/demo_i and env_args",))
    if isinstance(rate, int | float) and rate > 0:
        stated = replace(stated, rate_hz=float(rate))
    if about.get("type") == 1:
        # robosuite's documented order and units
        why = "robosuite's quaternions are xyzw and its positions in metres"
        stated = replace(stated, order="xyzw", units="m", frame="robosuite world", reasons=(*stated.reasons, why))
    return stated


def read_parquet(path: Path, declared: ImportSettings) -> list[Recording]:
    """Return the recordings of a Parquet file, or of all of a LeRobot data set.

    Raises:
        BadInputError: the file is damaged or too large, or it has no poses.
    """
    import pyarrow
    from pyarrow import parquet

    files = sorted(path.glob("data/**/*.parquet")) if path.is_dir() else [path]
    if not files:
        raise BadInputError(f"demos {path}: must hold data/**/*.parquet, found none")
    info, found = _info(path), []
    total = 0
    for each in files:
        try:
            source = parquet.ParquetFile(each)
            meta = source.metadata
            # What repeats takes few bytes in the file and many when it is read.
            total += max(
                sum(meta.row_group(index).total_byte_size for index in range(meta.num_row_groups)),
                8 * meta.num_rows * meta.num_columns,
            )
            check_size(path, total)
            found += _recordings(each, source.read(use_threads=False), info, declared)
        except (pyarrow.ArrowException, OSError) as error:
            raise BadInputError(f"demos {each}: must be an intact Parquet file, found: {error}") from error
    return found


def _info(path: Path) -> dict[str, Any]:
    """Return ``meta/info.json`` of the data set that a file belongs to; empty if there is none."""
    for folder in (path, *path.absolute().parents[:4]):
        place = folder / INFO
        if place.is_file() and place.stat().st_size < _LARGEST_INFO:
            try:
                content = json.loads(place.read_text(encoding="utf-8"))
            except ValueError as error:
                raise BadInputError(f"demos {place}: must hold JSON, found: {error}") from error
            return content if isinstance(content, dict) else {}
    return {}


def _recordings(path: Path, table: Any, info: dict[str, Any], declared: ImportSettings) -> list[Recording]:
    import pyarrow
    import pyarrow.compute

    names: list[str] = []
    parts: list[np.ndarray] = []
    for name in table.column_names:
        column = table[name].combine_chunks()
        kind = column.type
        if pyarrow.types.is_list(kind) or pyarrow.types.is_fixed_size_list(kind):
            if name != _STATE and _STATE in table.column_names:
                continue
            lengths = np.unique(pyarrow.compute.list_value_length(column).to_numpy(zero_copy_only=False))
            if len(lengths) != 1 or not (lengths[0] > 0 and _is_number(kind.value_type)):
                continue
            values = np.asarray(column.flatten().to_numpy(zero_copy_only=False), dtype=float)
            values = values.reshape(len(column), int(lengths[0]))
            names += _state_names(name, values.shape[1], info)
            parts.append(values)
        elif _is_number(kind):
            names.append(name)
            parts.append(np.asarray(column.to_numpy(zero_copy_only=False), dtype=float)[:, None])
    if not parts:
        raise BadInputError(f"demos {path}: must have columns of numbers, found none")
    fps = info.get("fps")
    reason = "a LeRobot data set" if info else "Parquet"
    stated = Recording(str(path), rate_hz=float(fps) if isinstance(fps, int | float) else None, reasons=(reason,))
    return recordings_of(ArrayColumns(str(path), tuple(names), np.hstack(parts)), declared, stated)


def _is_number(kind: Any) -> bool:
    import pyarrow

    return bool(pyarrow.types.is_integer(kind) or pyarrow.types.is_floating(kind))


def _state_names(name: str, count: int, info: dict[str, Any]) -> list[str]:
    """Return the names of a list column's numbers: those of ``info.json``, else numbered."""
    features = info.get("features", {})
    named = features.get(name, {}).get("names") if isinstance(features, dict) else None
    if isinstance(named, dict):
        named = next(iter(named.values()), None)
    if isinstance(named, list) and len(named) == count and all(isinstance(each, str) for each in named):
        return [str(each) for each in named]
    return [f"{name.rpartition('.')[2]}[{index}]" for index in range(count)]
