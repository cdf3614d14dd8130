"""Moving a set of demonstrations rigidly to where the arm can follow all of them."""

from collections.abc import Iterator, Sequence
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.dataset import Placement
from koopdqn.errors import BadInputError
from koopdqn.pose import Array

if TYPE_CHECKING:
    from koopdqn.tasks.reachability import Reachability

# Of a trajectory every so many poses are tried: a joint that stays within its bound over so many steps has room.
_EVERY = 6
# Moves tried: turns about the vertical [rad], and ways outward and upward [m].
_TURNS = np.radians([0, 30, -30, 60, -60, 90, -90, 120, -120, 150, -150, 180])
_OUTWARD = (0.0, 0.1, -0.1, 0.2, -0.2, 0.3, -0.3)
_UPWARD = (0.0, 0.1, -0.1, 0.2, -0.2, 0.3, -0.3, 0.4)
# What counts as much as 0.1 m, to try small moves first.
_TURN_LIKE_TEN_CENTIMETRES = np.radians(30)


def found_placement(reachability: "Reachability", trajectories: Sequence[Array]) -> Placement:
    """Return the smallest of the moves tried with which the arm can follow all trajectories (N, 7), with room.

    Around the arm's first joint all places are alike, so the set is turned about its own middle, and moved away from
    the base or toward it, and up or down.

    Raises:
        BadInputError: there is none.
    """
    middle = np.concatenate(trajectories)[:, pose.POSITION].mean(axis=0)
    tried = 0
    for placement in _candidates(middle):
        tried += 1
        placed = [placement.poses(rows) for rows in trajectories]
        # Coarsely first: that is quick, and stricter where joints are fast.
        if all(not blocked_at(reachability, rows, every) for every in (_EVERY, 1) for rows in placed):
            return placement
    raise BadInputError(
        f"demos.place=auto: must find a place where the arm can follow all {len(trajectories)} demonstrations, found"
        f" none among {tried} turns and moves"
    )


def blocked_at(reachability: "Reachability", trajectory: Array, every: int = 1) -> str:
    """Return where and why the arm cannot follow a trajectory (N, 7), or an empty string if it can.

    Args:
        reachability: the arm in its scene.
        trajectory: poses at the agent's step.
        every: only every so many poses are tried.
    """
    rows = trajectory[::every]
    motion = reachability.enter(rows[0])
    for index, here in enumerate(rows):
        if index and motion.joints is not None:
            motion = reachability.move(here, motion.joints)
        if motion.joints is None:
            share = index / max(len(rows) - 1, 1)
            place = np.round(here[pose.POSITION], 3).tolist()
            return f"{share:.0%} of its way, at {place} m: {motion.reason.replace('_', ' ')}: {motion.detail}"
    return ""


def _candidates(middle: Array) -> Iterator[Placement]:
    """Yield placements of a set around its middle (3,) [m], small ones first."""
    flat = np.array([middle[0], middle[1], 0.0])
    outward = flat / max(float(np.linalg.norm(flat)), 1e-9)
    moves = sorted(
        product(_TURNS, _OUTWARD, _UPWARD),
        key=lambda move: abs(move[0]) / _TURN_LIKE_TEN_CENTIMETRES + (abs(move[1]) + abs(move[2])) / 0.1,
    )
    for turn, out, up in moves:
        turned = pose.rotate(pose.from_rotation_vector([0.0, 0.0, turn]), middle)
        yield Placement(middle + out * outward + [0.0, 0.0, up] - turned, float(turn))
