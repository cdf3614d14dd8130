from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from parts import Parts, with_fields

from koopdqn.errors import BadInputError
from koopdqn.tasks.rollout import STEP_LIMIT, roll_out
from koopdqn.tasks.shelf import ShelfTask
from koopdqn.tasks.workcell import Workcell, open_workcell


def test_its_parts_are_of_one_piece(workcell: Workcell, parts: Parts) -> None:
    assert workcell.task is parts.task
    assert workcell.arm is workcell.scene.arm is workcell.reachability.arm
    assert workcell.scene is workcell.reachability.scene
    assert workcell.arm.step_seconds == parts.arm.step_seconds


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"waypoints": ((0.53, -0.2, 0.42), (0.59, -0.02, 0.47))}, "the goal .* without collision, found collision"),
        ({"waypoints": ((2.0, 0.0, 0.4), (0.59, 0.1, 0.47))}, "the start .* found unreachable"),
        ({"least_clearance_m": 0.15}, "must clear the scene by 150 mm, found"),
    ],
)
def test_a_workcell_in_which_the_task_cannot_be_done_is_refused(
    parts: Parts, changes: dict[str, object], message: str
) -> None:
    with pytest.raises(BadInputError, match=message):
        open_workcell(with_fields(parts.task, **changes), parts.arm)


@pytest.mark.parametrize(
    ("name", "own", "said"),
    [
        ("orientation", property(lambda task: "hold"), "be 'held' or 'learned', as a property, found 'hold'"),
        ("orientation", lambda task: "held", "be 'held' or 'learned', as a property, found <bound method"),
        ("rule", lambda task: "none", "be a text, as a property, found <bound method"),
        ("turned", lambda task, share: 0.5, r"return finite shares of shape \(101,\), found 0.5"),
        ("turned", lambda task, share: share[:, None], r"found an array of float64 of shape \(101, 1\)"),
        ("turned", lambda task, share: np.nan * share, r"finite shares of shape \(101,\), found nan$"),
        ("rule_broken", lambda task, poses: None, r"return booleans of shape \(\d+,\), one a pose, found None"),
        ("rule_broken", lambda task, poses: poses[:, :1] > 9, r"found an array of bool of shape \(\d+, 1\)"),
        ("rule_broken", lambda task, poses: poses[:, 2] - 0.9, "one a pose, found an array of float64"),
        ("rule_broken", lambda task, poses: np.zeros(3, dtype=bool), r"found an array of bool of shape \(3,\)$"),
        ("rule_broken", lambda task, poses: 2 * (poses[:, 2] < 9), "one a pose, found 2$"),
        ("measures", lambda task, path, step_seconds: 1.0, "return a dict of a number by each name, found 1.0"),
        ("measures", lambda task, path, step_seconds: {"x": path[0]}, "a number by each name, found {'x': array"),
    ],
)
def test_what_a_method_of_ones_own_returns_is_checked_before_any_work(
    parts: Parts, name: str, own: Any, said: str
) -> None:
    cls: Any = type("Own", (ShelfTask,), {name: own, "__module__": __name__})
    with pytest.raises(BadInputError, match=f"task shelf: {name} must .*{said}"):
        open_workcell(cls.model_construct(**dict(parts.task)), parts.arm)


@pytest.mark.parametrize("kind", [np.array, list, tuple, lambda broken: broken.astype(int)])
def test_a_rule_may_be_told_as_a_list_or_as_0_and_1(parts: Parts, kind: Callable[[np.ndarray], Any]) -> None:
    own = {"rule_broken": lambda task, poses: kind(poses[:, 2] > 9.0), "__module__": __name__}
    cls: Any = type("Own", (ShelfTask,), own)
    cell = open_workcell(cls.model_construct(**dict(parts.task)), parts.arm)
    start = cell.task.nominal_start[None]
    joints = np.array([cell.reachability.posture])
    (episode,) = roll_out(lambda poses, starts: np.zeros(1, dtype=int), cell.task, cell.reachability, start, joints, 3)
    assert episode.outcome == STEP_LIMIT
