"""Demonstration files: HDF5 in robomimic's layout."""

import hashlib
import json
import math
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from koopdqn.confined import MOST_BYTES, Content, confined
from koopdqn.demonstrations.dataset import Demonstration, Demonstrations, Placement
from koopdqn.errors import BadInputError
from koopdqn.files import atomic_path, parse_json
from koopdqn.settings import shown

FORMAT_VERSION = 1
_FRAME = "UR Base, flange (tool0)"
_QUATERNION_ORDER = "wxyz"
_UNITS = "m, s, rad"
_PLACEMENT = "placement"
_BLOCK = 512
_MARK = b"koopdqn sha256 "
_ASSUMED = {"frame": _FRAME, "quaternion_order": _QUATERNION_ORDER, "units": _UNITS}


def write_hdf5(path: Path, demonstrations: Demonstrations) -> None:
    """Write demonstrations to ``data/demo_i`` as robomimic lays them out; the file appears whole or not at all.

    The first 512 bytes, which HDF5 leaves to its users, hold the SHA-256 of the rest.

    Raises:
        BadInputError: there are more numbers than may be read back.
    """
    total = sum(
        item.times.nbytes + item.poses.nbytes + (0 if item.joints is None else item.joints.nbytes)
        for item in demonstrations.items
    )
    if total > MOST_BYTES:
        raise BadInputError(f"demonstrations must hold at most {MOST_BYTES} bytes of numbers, found {total}")
    # Composed in memory: on a full disk the HDF5 library takes the whole process down with it.
    image = BytesIO()
    with h5py.File(image, "w", userblock_size=_BLOCK) as file:
        data = file.create_group("data")
        data.attrs["format_version"] = FORMAT_VERSION
        data.attrs["total"] = sum(len(item) for item in demonstrations.items)
        data.attrs["env_args"] = json.dumps(
            {"env_name": demonstrations.task, "env_type": "koopdqn", "arm": demonstrations.arm}, sort_keys=True
        )
        data.attrs.update(_ASSUMED)
        if demonstrations.placement is not None:
            data.attrs[_PLACEMENT] = [*demonstrations.placement.offset, demonstrations.placement.turn]
        for index, item in enumerate(demonstrations.items):
            group = data.create_group(f"demo_{index}")
            group.attrs["num_samples"] = len(item)
            group.create_dataset("t", data=item.times)
            observations = group.create_group("obs")
            observations.create_dataset("eef_pos", data=item.poses[:, :3])
            observations.create_dataset("eef_quat", data=item.poses[:, 3:])
            if item.joints is not None:
                observations.create_dataset("joint_pos", data=item.joints)
        if demonstrations.held_out:
            # robomimic's masks of training and validation demonstrations.
            names = [f"demo_{index}" for index in range(len(demonstrations))]
            learned = len(names) - demonstrations.held_out
            mask = file.create_group("mask")
            mask.create_dataset("train", data=np.array(names[:learned], dtype="S"))
            mask.create_dataset("valid", data=np.array(names[learned:], dtype="S"))
    content = image.getbuffer()
    content[:_BLOCK] = _block(content[_BLOCK:])
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def read_hdf5(path: Path) -> Demonstrations:
    """Read demonstrations written by :func:`write_hdf5`.

    The library reads the file in a process of its own, bounded in time and memory (:mod:`koopdqn.confined`): a damaged
    file can make it hang where nothing interrupts it.

    Raises:
        BadInputError: the file is missing, is no HDF5 file, is truncated, was changed since koopdqn wrote it, lacks
            what the layout asks for, holds links or more than 256 MiB of numbers, or says that it uses another frame,
            quaternion order or unit.
    """
    if not path.is_file():
        found = "something else" if path.exists() else "nothing"
        raise BadInputError(f"demonstrations must be a file, found {found} at {path}")
    try:
        _check_block(path)
        about, arrays = confined(lambda: _read_file(path))
        return _demonstrations(about, iter(arrays))
    except BadInputError as error:
        raise BadInputError(f"demonstrations {path}: {error}") from error


def _block(content: bytes | memoryview) -> bytes:
    return _MARK + hashlib.sha256(content).hexdigest().encode() + b"\n" + bytes(_BLOCK - len(_MARK) - 65)


def _check_block(path: Path) -> None:
    """Raise if a file that says what it was written with holds something else."""
    try:
        with path.open("rb") as file:
            block = file.read(_BLOCK)
            if not block.startswith(_MARK):
                return
            size = path.stat().st_size
            if size > 2 * MOST_BYTES:
                raise BadInputError(f"must hold at most {2 * MOST_BYTES} bytes, found {size}")
            whole = block == _block(file.read())
    except OSError as error:
        raise BadInputError(f"must be readable, the system says: {error.strerror}") from error
    if not whole:
        raise BadInputError(
            "must hold the bytes it was written with, found others: it is damaged, or was changed by a program that"
            " kept the SHA-256 in its first 512 bytes"
        )


def _read_file(path: Path) -> Content:
    try:
        with h5py.File(path, "r") as file:
            return _read(file)
    except BadInputError:
        raise
    # what the library says of a damaged file is of any kind
    except Exception as error:
        raise BadInputError(
            f"must be HDF5 in robomimic's layout (data/demo_i/obs/eef_pos), found: {' '.join(str(error).split())}"
        ) from error


def _read(file: h5py.File) -> Content:
    data = _member(file, "data", h5py.Group)
    version = data.attrs.get("format_version", -1)
    if version != FORMAT_VERSION:
        raise BadInputError(f"format_version must be {FORMAT_VERSION}, found {version}")
    for key, assumed in _ASSUMED.items():
        found = data.attrs.get(key, assumed)
        if found != assumed:
            raise BadInputError(f"{key} must be {assumed}, found {found}")
    env = _read_env_args(data.attrs.get("env_args"))
    names = [name for name in data if name.startswith("demo_")]
    odd = [name for name in names if not (name[5:].isascii() and name[5:].isdecimal() and len(name) < 15)]
    if odd:
        raise BadInputError(f"demonstrations must be named demo_0, demo_1 and so on, found {shown(odd[0])}")
    names.sort(key=lambda name: int(name[5:]))
    arrays: list[np.ndarray] = []
    joints = []
    for name in names:
        group = _member(data, name, h5py.Group)
        observations = _member(group, "obs", h5py.Group)
        found = [_numbers(observations, key, arrays) for key in ("eef_pos", "eef_quat")]
        count = group.attrs["num_samples"]
        if found[0].shape != (count, 3) or found[1].shape != (count, 4):
            raise BadInputError(
                f"{name}: eef_pos and eef_quat must have shapes ({count}, 3) and ({count}, 4),"
                f" found {found[0].shape} and {found[1].shape}"
            )
        _numbers(group, "t", arrays)
        joints.append("joint_pos" in observations)
        if joints[-1]:
            _numbers(observations, "joint_pos", arrays)
    about = {
        "task": str(env["env_name"]),
        "arm": str(env.get("arm", "unknown")),
        "names": names,
        "joints": joints,
        "held_out": _held_out(file, names),
        "placement": _placement(data.attrs.get(_PLACEMENT)),
    }
    return about, arrays


def _member(group: h5py.Group, name: str, kind: type) -> Any:
    """Return a member of a group that lies in the file itself."""
    link = group.get(name, getlink=True)
    if link is not None and not isinstance(link, h5py.HardLink):
        raise BadInputError(f"{group.name}/{name} must lie in the file itself, found a link")
    found = group[name]
    if not isinstance(found, kind):
        raise BadInputError(f"{group.name}/{name} must be a {kind.__name__.lower()}, found something else")
    return found


def _numbers(group: h5py.Group, name: str, arrays: list[np.ndarray]) -> np.ndarray:
    """Return a dataset as numbers and add it to those read, once it is known to be no more than may be read."""
    dataset = _member(group, name, h5py.Dataset)
    if dataset.external or dataset.is_virtual:
        raise BadInputError(f"{dataset.name} must lie in the file itself, found it in others")
    if dataset.dtype.kind not in "fiu":
        raise BadInputError(f"{dataset.name} must hold numbers, found {shown(dataset.dtype)}")
    total = sum(values.nbytes for values in arrays) + 8 * math.prod(dataset.shape)
    if total > MOST_BYTES:
        raise BadInputError(f"must hold at most {MOST_BYTES} bytes of numbers, found {total} or more")
    arrays.append(np.asarray(dataset, dtype=float))
    return arrays[-1]


def _demonstrations(about: Any, arrays: Iterator[np.ndarray]) -> Demonstrations:
    items = []
    for name, has_joints in zip(about["names"], about["joints"], strict=True):
        position, quaternion, times = (next(arrays) for _ in range(3))
        try:
            joints = next(arrays) if has_joints else None
            items.append(Demonstration(times, np.hstack([position, quaternion]), joints))
        except BadInputError as error:
            raise BadInputError(f"{name}: {error}") from error
    moved = about["placement"]
    placement = None if moved is None else Placement(np.array(moved[:3]), moved[3])
    return Demonstrations(about["task"], about["arm"], items, about["held_out"], placement)


def _placement(values: Any) -> list[float] | None:
    if values is None:
        return None
    numbers = np.asarray(values, dtype=float)
    if numbers.shape != (4,) or not np.isfinite(numbers).all():
        raise BadInputError(f"{_PLACEMENT} must be three offsets [m] and a turn [rad], found {shown(values)}")
    return [float(number) for number in numbers]


def _held_out(file: h5py.File, names: list[str]) -> int:
    """Return how many demonstrations the file marks as held out; 0 where they are not the last ones."""
    if "mask" not in file or "valid" not in _member(file, "mask", h5py.Group):
        return 0
    valid = _member(file["mask"], "valid", h5py.Dataset)
    if valid.external or valid.is_virtual or valid.ndim != 1 or len(valid) > len(names):
        raise BadInputError("mask/valid must name demonstrations of the file, found something else")
    marked = {bytes(name).decode() for name in np.asarray(valid)}
    return len(marked) if marked == set(names[len(names) - len(marked) :]) and len(marked) < len(names) else 0


def _read_env_args(text: Any) -> dict[str, Any]:
    """Return robomimic's attribute ``env_args``, the file's origin."""
    try:
        about = parse_json(text)
    except (TypeError, ValueError):
        about = None
    if not isinstance(about, dict) or "env_name" not in about:
        raise BadInputError(
            f"must be HDF5 in robomimic's layout, its env_args a JSON object that holds env_name, found {shown(text)}"
        )
    return about
