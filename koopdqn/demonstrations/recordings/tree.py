"""Named arrays, nested as files nest them, to tables: what belongs together is one table."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import chain
from typing import Any, Final, TypeAlias

import numpy as np

from koopdqn.confined import MOST_BYTES
from koopdqn.demonstrations.recordings.columns import recordings_of, unnamed
from koopdqn.demonstrations.recordings.layout import shows_motion
from koopdqn.demonstrations.recordings.recording import ArrayColumns, ImportSettings, Recording
from koopdqn.errors import BadInputError
from koopdqn.pose import Array

Tree: TypeAlias = Mapping[str, Any]
"""Arrays, and trees of them, by name."""

LARGEST_BYTES: Final = MOST_BYTES
"""The most that is read from one file."""
# A table of poses has no more columns than an array may have to be one.
_WIDEST: Final = 64
_ASIDE: Final = ("next_obs", "actions", "rewards", "dones", "states", "mask")


def check_size(where: object, size: int) -> None:
    """Raise BadInputError if the arrays of a file take more bytes than are read."""
    if size > LARGEST_BYTES:
        raise BadInputError(
            f"demos {where}: must hold at most {LARGEST_BYTES >> 20} MiB of numbers, found {size >> 20} MiB"
        )


def recordings_of_tree(where: str, tree: Tree, declared: ImportSettings, stated: Recording) -> list[Recording]:
    """Return the recordings in nested arrays.

    Groups and arrays whose names differ in a number alone are demonstrations; what stands beside one another in one
    group and is equally long is one table.

    Raises:
        BadInputError: there is no table, or one's columns are not recognised.
    """
    found = []
    for name, table, left_out in _tables(tree):
        told = replace(stated, reasons=(*stated.reasons, left_out)) if left_out else stated
        try:
            found += _recordings_of_table(f"{where}: {name}" if name else where, table, declared, told)
        except BadInputError as error:
            if not left_out:
                raise
            raise BadInputError(f"{error}; {left_out}") from error
    if not found:
        raise BadInputError(f"demos {where}: must hold arrays of poses or joints, found none with two rows or more")
    return found


def _tables(tree: Tree, prefix: str = "") -> Iterator[tuple[str, dict[str, Array], str]]:
    """Yield the name of each table, its arrays, and which stood beside them and were left out, or an empty text."""
    kept = {name: value for name, value in tree.items() if name not in _ASIDE and not name.startswith("__")}
    series = _series(kept)
    if series:
        for name in series:
            value = kept[name]
            if isinstance(value, Mapping):
                yield from _tables(value, f"{prefix}{name}/")
            else:
                yield prefix + name, {"": _upright(value)}, ""
        return
    groups = [name for name, value in kept.items() if isinstance(value, Mapping)]
    if (len(groups) == 1 and len(kept) == 1) or any(_series(kept[name]) for name in groups):
        for name in groups:
            yield from _tables(kept[name], f"{prefix}{name}/")
        return
    raw = dict(_flat(kept))
    flat = {name: _upright(value) for name, value in raw.items()}
    stacks = [name for name, value in flat.items() if value.ndim == 3 and value.shape[1:] not in ((4, 4), (3, 3))]
    # A clock (D, N) beside poses (D, N, k) has a row for each demonstration, however few they are.
    clocks = {name for name in raw if stacks and raw[name].shape == flat[stacks[0]].shape[:2]}
    tables = [value for name, value in flat.items() if name not in clocks and value.ndim == 2]
    if stacks and not any(value.shape[1] in (3, 4, 7) for value in tables):
        stack = flat[stacks[0]]
        beside = {name: raw[name] if name in clocks else value for name, value in flat.items()}
        # One clock may be all demonstrations'.
        shared = {name: value for name, value in beside.items() if value.shape == stack.shape[1:2]}
        for index in range(len(stack)):
            own = {name: value[index] for name, value in beside.items() if value.ndim > 1 and len(value) == len(stack)}
            rows = own | shared
            yield f"{prefix}{stacks[0]}[{index}]", rows, ""
        return
    lengths = Counter(len(value) for value in flat.values() if len(value) > 1)
    if lengths:
        longest = max(lengths, key=lambda each: (lengths[each], each))
        others = [f"{name} of {len(value)} rows" for name, value in flat.items() if 1 < len(value) != longest]
        left_out = f"left out beside tables of {longest} rows: {', '.join(others)}" if others else ""
        yield prefix.rstrip("/"), {name: value for name, value in flat.items() if len(value) == longest}, left_out


def _series(tree: Tree) -> list[str]:
    """Return, in natural order, the names that differ in a number alone and stand for groups or tables."""
    numbered: dict[str, list[tuple[int, str]]] = {}
    for name, value in tree.items():
        found = re.fullmatch(r"(.*?)_?(\d+)", name)
        if found and (isinstance(value, Mapping) or (value.ndim in (2, 3) and min(value.shape[:2]) > 4)):
            numbered.setdefault(found[1], []).append((int(found[2]), name))
    longest: list[tuple[int, str]] = max(numbered.values(), key=len, default=[])
    # A single one with something beside it has its number for another reason.
    return [name for _, name in sorted(longest)] if len(longest) > 1 or len(tree) == 1 else []


def _flat(tree: Tree, prefix: str = "") -> Iterator[tuple[str, Array]]:
    for name, value in tree.items():
        if name in _ASIDE:
            continue
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        elif value.dtype.kind in "fiu" and value.ndim in (1, 2, 3) and value.size:
            yield prefix + name, value


def _upright(value: Array) -> Array:
    """Return an array whose rows are samples: MATLAB often has a column a sample, and 4×4×N for matrices."""
    if value.ndim == 3 and value.shape[:2] in ((4, 4), (3, 3)) and value.shape[2] not in (3, 4):
        return value.transpose(2, 0, 1)
    if value.ndim == 2 and value.shape[0] == 1:
        # So few are one sample.
        return np.asarray(value[0]) if value.shape[1] > 16 else value
    if value.ndim == 2 and value.shape[0] <= 16 and value.shape[1] > 4 * value.shape[0]:
        return value.T
    return value


def _recordings_of_table(
    where: str, table: dict[str, Array], declared: ImportSettings, stated: Recording
) -> list[Recording]:
    names: list[list[str]] = []
    parts: list[Array] = []
    for name, value in table.items():
        rows = value.reshape(len(value), -1).astype(float)
        if rows.shape[1] <= _WIDEST:
            names.append([name] if rows.shape[1] == 1 else [f"{name}[{index}]" for index in range(rows.shape[1])])
            parts.append(rows)
    if not parts:
        raise BadInputError(f"demos {where}: must hold arrays of poses or joints, found none")
    reasons, wide = stated.reasons, [index for index, part in enumerate(parts) if part.shape[1] > 1]
    alone = len(parts) == 1
    if len(wide) == 1 and (alone or not (declared.columns or shows_motion(list(chain(*names))))):
        # What the columns of the one wide array are is not in its name.
        try:
            own, why = unnamed(where, parts[wide[0]], declared)
        except BadInputError:
            if alone:
                raise
        else:
            names[wide[0]], reasons = list(own), (*reasons, *why)
    columns = ArrayColumns(where, tuple(chain(*names)), np.hstack(parts))
    return recordings_of(columns, declared, replace(stated, reasons=reasons))
