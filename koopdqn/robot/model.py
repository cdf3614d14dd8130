"""What an MJCF file says of an arm: the hinges that move a site, their ranges, their motors and a posture."""

import hashlib
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from koopdqn import pose
from koopdqn.errors import unknown_name
from koopdqn.robot.chain import Chain

_FREE: Final = 2.0 * np.pi
"""Range of a hinge without limits, to either side [rad]."""
_FEWEST: Final = 6
_ROUNDED: Final = 0.01


class Model(NamedTuple):
    """What an MJCF file says of the arm up to a site.

    Attributes:
        name: of the model.
        joints: names (n,) of the hinges from the base to the site.
        chain: their axes, the site as the flange, and their ranges.
        torques: (n,) largest [Nm] that their motors give; 0 where the file does not limit them.
        home: (n,) of the first keyframe, or the middle of every range [rad].
        sha256: of the file, or of it and of all that it includes and names.
        file_sha256: of the file alone.
    """

    name: str
    joints: tuple[str, ...]
    chain: Chain
    torques: tuple[float, ...]
    home: tuple[float, ...]
    sha256: str
    file_sha256: str


def read_model(path: Path, site: str) -> Model:
    """Return what an MJCF file says of the arm that carries a site.

    Raises:
        ValueError: MuJoCo cannot compile the file, it has no such site, or the site is moved by anything but hinges
            with names, six or more, each by a position actuator.
    """
    if not path.is_file():
        raise ValueError(f"path: must name an MJCF file, found {'a folder' if path.is_dir() else 'nothing'} at {path}")
    files = _files(path.resolve())
    return _read(files, site, tuple(each.stat().st_mtime_ns for each in files))


def _files(path: Path) -> tuple[Path, ...]:
    """Return an MJCF file, and after it what it includes and the meshes and pictures that it names."""
    import mujoco

    try:
        found = mujoco.mju_getXMLDependencies(str(path))
    except mujoco.FatalError:
        found = []
    # What is wrong, or missing, compiling says better.
    return path, *sorted({Path(each).resolve() for each in found if Path(each).is_file()} - {path})


def _digest(files: tuple[Path, ...]) -> str:
    each = [hashlib.sha256(file.read_bytes()).hexdigest() for file in files]
    return each[0] if len(each) == 1 else hashlib.sha256("\n".join(each).encode()).hexdigest()


@lru_cache(maxsize=8)
def _read(files: tuple[Path, ...], site: str, changed_ns: tuple[int, ...]) -> Model:
    import mujoco

    path = files[0]

    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ValueError(f"path: {path} must compile in MuJoCo, which says: {' '.join(str(error).split())}") from error
    names = [model.site(index).name for index in range(model.nsite)]
    if site not in names:
        raise ValueError(str(unknown_name(f"site of {path.name}", site, names)))
    where = names.index(site)
    joints = _joints(model, int(model.site_bodyid[where]))
    kinds = [mujoco.mjtJoint(int(model.jnt_type[joint])).name.removeprefix("mjJNT_").lower() for joint in joints]
    odd = [f"a {kind} joint {model.joint(j).name}" for j, kind in zip(joints, kinds, strict=True) if kind != "hinge"]
    nameless = sum(not model.joint(joint).name for joint in joints)
    if odd or nameless or len(joints) < _FEWEST:
        found = odd[0].strip() if odd else f"{len(joints)}" + (f", {nameless} without a name" if nameless else "")
        raise ValueError(f"site: {site} must be moved by {_FEWEST} or more hinges that have names, found {found}")
    _check_actuators(model, joints)
    address = model.jnt_qposadr[joints]
    data = mujoco.MjData(model)
    data.qpos[address] = 0.0
    mujoco.mj_kinematics(model, data)
    tip = pose.make(data.site_xpos[where], pose.from_matrix(data.site_xmat[where].reshape(3, 3)))
    limited = model.jnt_limited[joints].astype(bool)
    lower, upper = (np.where(limited, model.jnt_range[joints, side], sign * _FREE) for side, sign in ((0, -1), (1, 1)))
    driven = driven_joints(model)
    motors = [driven.index(joint) for joint in joints]
    # No farther than it can be told to go.
    told = model.actuator_ctrlrange[motors] + np.where(model.actuator_ctrllimited[motors, None], 0.0, [-np.inf, np.inf])
    lower, upper = np.maximum(lower, told[:, 0]), np.minimum(upper, told[:, 1])
    home = model.key_qpos[0][address] if model.nkey else 0.5 * (lower + upper)
    # A keyframe may be rounded otherwise than a range.
    inside = np.clip(home, lower, upper)
    home = np.where(np.abs(inside - home) < _ROUNDED, inside, home)
    return Model(
        _name(model, path),
        tuple(model.joint(joint).name for joint in joints),
        Chain(data.xanchor[joints].copy(), data.xaxis[joints].copy(), tip, lower, upper),
        tuple(_torque(model, joint) for joint in joints),
        tuple(home.tolist()),
        _digest(files),
        _digest(files[:1]),
    )


def _name(model: Any, path: Path) -> str:
    name = bytes(model.names).partition(b"\0")[0].decode(errors="replace").strip()
    return name if name and name.isprintable() else path.stem


def _joints(model: Any, body: int) -> list[int]:
    """Return the joints that move a body, from the base on."""
    joints: list[int] = []
    while body:
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        joints = [*range(first, first + count), *joints]
        body = int(model.body_parentid[body])
    return joints


def driven_joints(model: Any) -> list[int]:
    """Return the joint that each actuator of a ``mujoco.MjModel`` drives; −1 of one that drives something else."""
    import mujoco

    # A tendon or a site may have a joint's number.
    on_joint = np.isin(model.actuator_trntype, (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    return list(np.where(on_joint, model.actuator_trnid[:, 0], -1).tolist())


def _check_actuators(model: Any, joints: list[int]) -> None:
    driven = driven_joints(model)
    for joint in joints:
        name = model.joint(joint).name
        if joint not in driven:
            raise ValueError(f"path: must be a file with an actuator for every joint, found none for {name}")
        motor = driven.index(joint)
        pull = float(model.actuator_biasprm[motor, 1])
        if pull >= 0:
            raise ValueError(
                f"path: the actuator of {name} must be a position actuator (biasprm[1] = -kp < 0), found biasprm[1] ="
                f" {pull:g}"
            )
        gain, gear, shift = (
            model.actuator_gainprm[motor, 0],
            model.actuator_gear[motor, 0],
            model.actuator_biasprm[motor, 0],
        )
        if not (np.isclose(gain, -pull) and gear == 1.0 and shift == 0.0):
            raise ValueError(
                f"path: the actuator of {name} must be set to the joint's own angle (gear 1, gainprm[0] = -biasprm[1] ="
                f" {-pull:g}, biasprm[0] = 0), found gear {gear:g}, gainprm[0] = {gain:g}, biasprm[0] = {shift:g}"
            )


def _torque(model: Any, joint: int) -> float:
    """Return the largest torque [Nm] that a joint's motors give together, or 0 if the file does not limit it."""
    import mujoco

    if model.jnt_actfrclimited[joint]:
        return float(np.abs(model.jnt_actfrcrange[joint]).max())
    on_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    motors = np.flatnonzero(on_joint & (model.actuator_trnid[:, 0] == joint))
    if not len(motors) or not model.actuator_forcelimited[motors].all():
        return 0.0
    ranges = np.abs(model.actuator_forcerange[motors]).max(axis=1)
    return float((ranges * np.abs(model.actuator_gear[motors, 0])).sum())
