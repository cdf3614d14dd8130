"""Demonstration files: HDF5 in robomimic's layout."""

import json
from pathlib import Path

import h5py
import numpy as np

from koopdqn.demonstrations.dataset import Demonstration, Demonstrations
from koopdqn.errors import BadInputError
from koopdqn.files import atomic_path

FORMAT_VERSION = 1
_FRAME = "UR Base, flange (tool0)"
_QUATERNION_ORDER = "wxyz"


def write_hdf5(path: Path, demonstrations: Demonstrations) -> None:
    """Write demonstrations to ``data/demo_i`` as robomimic lays them out; the file appears whole or not at all."""
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        data = file.create_group("data")
        data.attrs["format_version"] = FORMAT_VERSION
        data.attrs["total"] = sum(len(item) for item in demonstrations.items)
        data.attrs["env_args"] = json.dumps(
            {"env_name": demonstrations.task, "env_type": "koopdqn", "arm": demonstrations.arm}, sort_keys=True
        )
        data.attrs["frame"] = _FRAME
        data.attrs["quaternion_order"] = _QUATERNION_ORDER
        data.attrs["units"] = "m, s, rad"
        for index, item in enumerate(demonstrations.items):
            group = data.create_group(f"demo_{index}")
            group.attrs["num_samples"] = len(item)
            group.create_dataset("t", data=item.times)
            observations = group.create_group("obs")
            observations.create_dataset("eef_pos", data=item.poses[:, :3])
            observations.create_dataset("eef_quat", data=item.poses[:, 3:])
            if item.joints is not None:
                observations.create_dataset("joint_pos", data=item.joints)


def read_hdf5(path: Path) -> Demonstrations:
    """Read demonstrations written by :func:`write_hdf5`.

    Raises:
        BadInputError: the file is missing, is no HDF5 file, is truncated, or lacks what the layout asks for.
    """
    if not path.is_file():
        raise BadInputError(f"demonstrations must be a file, found nothing at {path}")
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
    order = data.attrs.get("quaternion_order", _QUATERNION_ORDER)
    if order != _QUATERNION_ORDER:
        raise BadInputError(f"quaternion_order must be {_QUATERNION_ORDER}, found {order}")
    about = json.loads(data.attrs["env_args"])
    names = sorted((name for name in data if name.startswith("demo_")), key=lambda name: int(name[5:]))
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
        items.append(Demonstration(np.asarray(group["t"]), np.hstack([position, quaternion]), joints))
    return Demonstrations(str(about["env_name"]), str(about.get("arm", "unknown")), items)
