import pytest
from parts import Parts, with_fields

from koopdqn.errors import BadInputError
from koopdqn.tasks.workcell import Workcell, open_workcell


def test_its_parts_are_of_one_piece(workcell: Workcell, parts: Parts) -> None:
    assert workcell.task is parts.task
    assert workcell.arm is workcell.scene.arm is workcell.reachability.arm
    assert workcell.scene is workcell.reachability.scene
    assert workcell.reachability.step_seconds == parts.arm.step_seconds


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
