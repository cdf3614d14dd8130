"""An arm given by any MJCF file: its hinges up to a site, with closed-form inverse kinematics where there is one."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal, cast

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from koopdqn.pose import Array
from koopdqn.robot.arm import Arm, InverseResult, check_limits, unwrapped_batch
from koopdqn.robot.chain import Chain, ClosedForm
from koopdqn.robot.model import Model, read_model
from koopdqn.settings import TARGET, Floats, Line, Name, Names, PathText, Positive, Settings, load_settings

_SAME_RAD: Final = 1e-3
"""Solutions nearer than that are one."""
_LISTS: Final = ("joint_lower", "joint_upper", "velocity_limits", "torque_limits", "home")


class MjcfArm(Settings):
    """An arm of an MJCF file as MuJoCo Menagerie has them; an :class:`koopdqn.robot.arm.Arm` of any number of joints.

    The base frame is the file's world frame, the flange the site, whose z axis points out of it. What is null is
    taken from the file, so that an arm that was made knows all its numbers.

    Raises:
        ValueError: on construction, the file cannot be compiled, is another than the one that ``sha256`` tells, has no
            such site, moves it by anything but six or more hinges with position actuators, or does not say what must
            be known.
    """

    # Where it lies is of this machine: artifacts hold the file's SHA-256 instead.
    path: PathText = Field(exclude=True)
    site: Name
    name: Line
    sha256: Name
    joint_names: Names
    joint_lower: Floats
    joint_upper: Floats
    velocity_limits: Floats
    torque_limits: Floats
    home: Floats
    kinematics: Literal["analytic", "numeric"]
    step_seconds: Positive
    task_scale: Positive

    @model_validator(mode="before")
    @classmethod
    def _read(cls, given: Any) -> Any:
        if not isinstance(given, Mapping):
            return given
        known = {key: value for key, value in given.items() if value is not None and value != "auto"}
        for key, rule in (("path", "the arm's MJCF file"), ("site", "the site that is the flange")):
            if not isinstance(known.get(key), str | Path) or not str(known[key]).strip():
                raise ValueError(f"{key}: must name {rule}, found {given.get(key)!r}")
        model = read_model(Path(known["path"]), str(known["site"]))
        # An earlier koopdqn wrote that of the file alone.
        if known.get("sha256", model.sha256) not in (model.sha256, model.file_sha256):
            raise ValueError(
                f"path: must be the file whose SHA-256 is {known['sha256']}, found {model.sha256} for {known['path']}"
            )
        # One number stands for all joints.
        for key in _LISTS:
            if isinstance(known.get(key), int | float):
                known[key] = (known[key],) * len(model.joints)
        read = {
            "name": model.name,
            "joint_names": model.joints,
            "joint_lower": tuple(model.chain.lower.tolist()),
            "joint_upper": tuple(model.chain.upper.tolist()),
            "torque_limits": model.torques,
            "home": model.home,
            "kinematics": "analytic" if _has_closed_form(model.chain) else "numeric",
        }
        return {**read, **known, "sha256": model.sha256}

    @model_validator(mode="after")
    def _check(self) -> "MjcfArm":
        model = self._model
        if self.joint_names != model.joints:
            raise ValueError(f"joint_names: must be those of the file, {list(model.joints)}, found {self.joint_names}")
        for key in _LISTS:
            if len(getattr(self, key)) != len(self.joint_names):
                raise ValueError(f"{key}: must be {len(self.joint_names)} numbers, found {list(getattr(self, key))}")
        for name, torque in zip(self.joint_names, self.torque_limits, strict=True):
            if torque <= 0.0:
                raise ValueError(f"torque_limits: must be given for {name}, whose actuator has none in the file")
        check_limits(self)
        if self.kinematics == "analytic":
            # Says why where there is none.
            _ = self._closed
        return self

    @property
    def asset(self) -> str:
        """Name of the file, for people."""
        return self.path.name

    @property
    def mjcf(self) -> Path:
        """Path of the arm's MJCF file."""
        return self.path

    @property
    def flange_site(self) -> str:
        """The site."""
        return self.site

    def forward(self, joints: ArrayLike) -> Array:
        """Return the flange poses (..., 7) of joint angles (..., n) [rad]."""
        angles = np.asarray(joints, dtype=float)
        if angles.ndim == 0 or angles.shape[-1] != len(self.home):
            raise ValueError(f"joints must have shape (..., {len(self.home)}), found {angles.shape}")
        return self._chain.forward(angles)

    def inverse(self, pose: ArrayLike, seed: ArrayLike) -> InverseResult:
        """Return joint angles near ``seed`` (n,) [rad] that bring the flange to ``pose`` (7,).

        Of the solutions in closed form it is the nearest to the seed. Without a closed form it is the one that
        small steps from the seed lead to, or where they lead to none, the nearest that they find from elsewhere.

        Raises:
            ValueError: the pose or the seed has a wrong shape or is not finite.
        """
        target, near = np.asarray(pose, dtype=float), np.asarray(seed, dtype=float)
        found = self.inverse_batch(target[None], near[None])[0]
        success = not np.isnan(found).any()
        joints = found if success else near.copy()
        joints.setflags(write=False)
        reason = "" if success else f"out of reach: no joint angles within the limits of {self.name} were found"
        return InverseResult(joints, success, reason)

    def inverse_batch(self, poses: ArrayLike, seeds: ArrayLike) -> Array:
        """Return the joint angles (N, n) [rad] that :meth:`inverse` finds for poses (N, 7) from seeds (N, n), or NaN.

        Raises:
            ValueError: poses or seeds have a wrong shape or are not finite.
        """
        targets, near = np.asarray(poses, dtype=float), np.asarray(seeds, dtype=float)
        count = len(self.home)
        if targets.ndim != 2 or targets.shape[1] != 7 or near.shape != (len(targets), count):
            raise ValueError(
                f"poses and seeds must have shapes (N, 7) and (N, {count}), found {targets.shape}, {near.shape}"
            )
        if not (np.isfinite(targets).all() and np.isfinite(near).all()):
            raise ValueError("poses and seeds must be finite, found NaN or infinity")
        if self.kinematics == "analytic":
            joints = self._nearest(self._closed.solutions(targets), near)
        else:
            joints = self._chain.inverse(targets, near)
        for row in np.flatnonzero(np.isnan(joints).any(axis=1)):
            elsewhere = self._searched(targets[row], near[row])
            if len(elsewhere):
                joints[row] = elsewhere[0]
        return joints

    def solutions(self, pose: ArrayLike, seed: ArrayLike | None = None) -> Array:
        """Return solutions (k, n) [rad] for ``pose`` (7,), nearest to ``seed`` first (home if None).

        All of the closed form; else those found from the seed and from home. From home itself, and where these find
        none, eight other postures are tried.
        """
        near = np.asarray(self.home if seed is None else seed, dtype=float)
        target = np.asarray(pose, dtype=float)
        if self.kinematics == "analytic":
            exact = self._sorted(self._closed.solutions(target[None])[:, 0], near)
            if len(exact):
                return exact
        return self._searched(target, near)

    def _searched(self, target: Array, near: Array) -> Array:
        """Return the solutions (k, n) that small steps find from a seed (n,), home and elsewhere."""
        home = np.array(self.home)
        found = self._found_from(np.array([near, home]), target)
        if np.isnan(found).any(axis=1).all() or (near == home).all():
            found = np.vstack([found, self._found_from(self._chain.restarts, target)])
        return self._sorted(found, near)

    def _found_from(self, begin: Array, target: Array) -> Array:
        return self._chain.inverse(np.tile(target, (len(begin), 1)), begin)

    def _sorted(self, found: Array, near: Array) -> Array:
        """Return solutions (k, n) within the limits, each once, turned and sorted to lie nearest (n,)."""
        angles, within = unwrapped_batch(found.T, near[:, None], self.joint_lower, self.joint_upper)
        rows = angles.T[within.all(axis=0)]
        rows = rows[np.argsort(np.abs(rows - near).max(axis=1, initial=0.0), kind="stable")]
        kept: list[Array] = []
        for row in rows:
            if all(np.abs(row - other).max() > _SAME_RAD for other in kept):
                kept.append(row)
        return np.array(kept).reshape(-1, len(near))

    def _nearest(self, found: Array, near: Array) -> Array:
        """Return of solutions (S, N, n), NaN where there are fewer, the one nearest to seeds (N, n); NaN if none."""
        angles, within = unwrapped_batch(np.moveaxis(found, -1, 0), near.T[:, None], self.joint_lower, self.joint_upper)
        steps = np.where(within.all(axis=0), np.abs(angles - near.T[:, None]).max(axis=0), np.inf)
        best, rows = steps.argmin(axis=0), np.arange(len(near))
        return np.where(np.isfinite(steps[best, rows]), angles[:, best, rows], np.nan).T

    @property
    def _model(self) -> Model:
        return read_model(self.path, self.site)

    @cached_property
    def _chain(self) -> Chain:
        lower, upper = np.array(self.joint_lower), np.array(self.joint_upper)
        return replace(self._model.chain, lower=lower, upper=upper)

    @cached_property
    def _closed(self) -> ClosedForm:
        return ClosedForm(self._model.chain)


def _has_closed_form(chain: Chain) -> bool:
    try:
        ClosedForm(chain)
    except ValueError:
        return False
    return True


def recorded_arm(held: Mapping[str, Any], mine: Arm) -> Arm | None:
    """Return the arm that an artifact holds; one of a file lies where ``mine`` does, since artifacts name no place.

    It is None if it is one of a file and ``mine`` is not.

    Raises:
        BadInputError: it is no arm, or of another file.
    """
    of_file = held.get(TARGET) == f"{MjcfArm.__module__}.{MjcfArm.__qualname__}"
    if of_file and not isinstance(mine, MjcfArm):
        return None
    place = {"path": mine.mjcf} if of_file and isinstance(mine, MjcfArm) else {}
    arm: Any = load_settings({**held, **place}, Arm, "robot")
    return cast(Arm, arm)
