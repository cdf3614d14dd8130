"""Closed-form inverse kinematics of a chain of six hinges, where EAIK knows one (Ostermeier, Külz & Althoff 2024)."""

from typing import Any

import numpy as np

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.robot.chain import Chain

_JOINTS = 6


class ClosedForm:
    """The inverse of a chain by subproblem decomposition: a spherical wrist, parallel or intersecting axes."""

    def __init__(self, chain: Chain) -> None:
        """Find the decomposition.

        Raises:
            ValueError: there is none, or EAIK is not installed.
        """
        try:
            from eaik.IK_HP import HPRobot
        except ImportError as error:
            raise ValueError(
                "kinematics: analytic needs EAIK, found it not installed: pip install 'koopdqn[analytic]'"
            ) from error
        places = np.vstack([np.zeros(3), chain.anchors, chain.tip[pose.POSITION]])
        robot: Any = HPRobot(chain.axes, np.diff(places, axis=0)) if len(chain.axes) == _JOINTS else None
        if robot is None or not robot.hasKnownDecomposition():
            raise ValueError("kinematics: must be numeric, as EAIK knows no closed form of this arm, found 'analytic'")
        self._robot = robot
        self._back = pose.to_matrix(chain.tip[pose.QUATERNION]).T

    def solutions(self, targets: Array) -> Array:
        """Return solutions (S, N, 6) [rad] of poses (N, 7), not unwrapped; NaN where a pose has fewer than S."""
        matrices = np.tile(np.eye(4), (len(targets), 1, 1))
        matrices[:, :3, :3] = pose.to_matrix(pose.normalized(targets[:, pose.QUATERNION])) @ self._back
        matrices[:, :3, 3] = targets[:, pose.POSITION]
        # EAIK also returns the nearest that can be done where nothing reaches the pose.
        exact = [
            np.reshape(found.Q, (-1, _JOINTS))[~np.array(found.is_LS, dtype=bool)]
            for found in self._robot.IK_batched(matrices, 1)
        ]
        result = np.full((max(map(len, exact), default=1) or 1, len(targets), _JOINTS), np.nan)
        for row, angles in enumerate(exact):
            result[: len(angles), row] = angles
        return result
