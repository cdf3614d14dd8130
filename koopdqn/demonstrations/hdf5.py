"""Demonstration files: HDF5 in robomimic's layout."""

import json
from io import BytesIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from koopdqn.demonstrations.dataset import Demonstration, Demonstrations, Placement
from koopdqn.errors import BadInputError
from koopdqn.files import atomic_path
from koopdqn.settings import shown

FORMAT_VERSION = 1
_FRAME = "UR Base, flange (tool0)"
_QUATERNION_ORDER = "wxyz"
_UNITS = "m, s, rad"
_PLACEMENT = "placement"
_LEARNED, _HELD_OUT = "mask/train", "mask/valid"
_ASSUMED = {"frame": _FRAME, "quaternion_order": _QUATERNION_ORDER, "units": _UNITS}


def write_hdf5(path: Path, demonstrations: Demonstrations) -> None:
    """Write demonstrations to ``data/demo_i`` in robomimic's layout, atomically."""
    # Composed in memory: on a full disk the HDF5 library aborts the process.
    image = BytesIO()
    with h5py.File(image, "w") as file:
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
            file.create_dataset(_LEARNED, data=np.array(names[:learned], dtype="S"))
            file.create_dataset(_HELD_OUT, data=np.array(names[learned:], dtype="S"))
    with atomic_path(path) as temporary:
        temporary.write_bytes(image.getvalue())


def read_hdf5(path: Path) -> Demonstrations:
    """Read demonstrations written by :func:`write_hdf5`.

    Raises:
        BadInputError: the file is missing, no HDF5, truncated, of another layout, or of another frame, quaternion
            order or unit.
    """
    if not path.is_file():
        found = "something else" if path.exists() else "nothing"
        raise BadInputError(f"demonstrations must be a file, found {found} at {path}")
    try:
        with h5py.File(path, "r") as file:
            return _read(file)
    except BadInputError as error:
        raise BadInputError(f"demonstrations {path}: {error}") from error
    except (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError) as error:
        raise BadInputError(
            f"demonstrations {path}: must be HDF5 in robomimic's layout (data/demo_i/obs/eef_pos), found: {error}"
        ) from error


def _read(file: h5py.File) -> Demonstrations:
    data = file["data"]
    version = int(data.attrs.get("format_version", -1))
    if version != FORMAT_VERSION:
        raise BadInputError(f"format_version must be {FORMAT_VERSION}, found {version}")
    for key, assumed in _ASSUMED.items():
        found = data.attrs.get(key, assumed)
        if found != assumed:
            raise BadInputError(f"{key} must be {assumed}, found {found}")
    about = _read_env_args(data.attrs.get("env_args"))
    names = [name for name in data if name.startswith("demo_")]
    odd = [name for name in names if not name[5:].isdecimal()]
    if odd:
        raise BadInputError(f"demonstrations must be named demo_0, demo_1 and so on, found {odd[0]}")
    names.sort(key=lambda name: int(name[5:]))
    items = []
    for name in names:
        group = data[name]
        observations = group["obs"]
        position, quaternion = np.asarray(observations["eef_pos"]), np.asarray(observations["eef_quat"])
        count = int(group.attrs["num_samples"])
        if position.shape != (count, 3) or quaternion.shape != (count, 4):
            raise BadInputError(
                f"{name}: eef_pos and eef_quat must have shapes ({count}, 3) and ({count}, 4),"
                f" found {position.shape} and {quaternion.shape}"
            )
        joints = np.asarray(observations["joint_pos"]) if "joint_pos" in observations else None
        try:
            items.append(Demonstration(np.asarray(group["t"]), np.hstack([position, quaternion]), joints))
        except BadInputError as error:
            raise BadInputError(f"{name}: {error}") from error
    arm, placement = str(about.get("arm", "unknown")), _placement(data.attrs.get(_PLACEMENT))
    return Demonstrations(str(about["env_name"]), arm, items, _held_out(file, names), placement)


def _placement(values: Any) -> Placement | None:
    if values is None:
        return None
    numbers = np.asarray(values, dtype=float)
    if numbers.shape != (4,) or not np.isfinite(numbers).all():
        raise BadInputError(f"{_PLACEMENT} must be three offsets [m] and a turn [rad], found {shown(values)}")
    return Placement(numbers[:3], float(numbers[3]))


def _held_out(file: h5py.File, names: list[str]) -> int:
    """Return the number of held-out demonstrations in the file's masks; 0 if they are not the last ones."""
    if _HELD_OUT not in file:
        return 0
    marked = {bytes(name).decode() for name in np.asarray(file[_HELD_OUT])}
    return len(marked) if marked == set(names[len(names) - len(marked) :]) and len(marked) < len(names) else 0


def _read_env_args(text: Any) -> dict[str, Any]:
    """Return robomimic's attribute ``env_args``, the file's origin."""
    try:
        about = json.loads(text)
    except (TypeError, ValueError):
        about = None
    if not isinstance(about, dict) or "env_name" not in about:
        raise BadInputError(
            f"must be HDF5 in robomimic's layout, its env_args a JSON object that holds env_name, found {shown(text)}"
        )
    return about
