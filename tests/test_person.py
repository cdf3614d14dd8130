import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from parts import load_parts, with_fields

from koopdqn import pose
from koopdqn.artifact import described
from koopdqn.errors import BadInputError
from koopdqn.pose import Array
from koopdqn.settings import load_settings
from koopdqn.tasks.person import Expert, Person, Pursuit, ReferencePath, Square, Via, Wide, least_jerk
from koopdqn.tasks.shelf import ShelfTask
from koopdqn.tasks.task import Task
from koopdqn.tasks.workcell import Workcell, open_workcell

STEP = 0.002
UPRIGHT = np.array([0.0, 1.0, 0.0, 0.0])
STRAIGHT = ReferencePath.along(pose.make([[0.0, 0, 0], [0.4, 0, 0]], UPRIGHT))
GOAL = pose.make([0.4, 0, 0], UPRIGHT)
PERSONS = ("pursuit", "square", "via", "wide")

offsets = st.floats(-0.03, 0.03, allow_nan=False)


def walked(person: Person, start: tuple[float, float, float], step: float = STEP) -> Array:
    """Return the positions (T, 3) that a person passes along a straight path of 0.4 m in x."""
    return person.expert(STRAIGHT, GOAL, step, 0.0).roll_out(pose.make(start, UPRIGHT), 4000)[:, :3]


@pytest.mark.parametrize("person", PERSONS)
@pytest.mark.parametrize("task", ["shelf", "knife"])
def test_each_comes_to_rest_at_the_goal_from_anywhere_in_the_start_region(task: str, person: str) -> None:
    from koopdqn.app.commands.configuration import Configuration
    from koopdqn.app.hydra.compose import composed
    from koopdqn.evaluation.metrics import reference_paths

    chosen = Configuration.load(composed([f"task={task}", f"person={person}"])).task
    assert chosen.person.name == person
    starts = chosen.draw_starts(np.random.default_rng(0), 30)
    ends = np.array([path[-1] for path in reference_paths(chosen, starts, 2000)])
    np.testing.assert_allclose(pose.position_distance(ends, chosen.goal), 0.0, atol=1e-6)
    np.testing.assert_allclose(pose.rotation_distance(ends, chosen.goal), 0.0, atol=1e-6)


@settings(max_examples=15)
@given(y=st.floats(-0.005, 0.005), z=st.floats(-0.005, 0.005), ahead=st.sampled_from([0.005, 0.015, 0.06]))
def test_in_pursuit_small_offsets_die_out_over_the_look_ahead_distance(y: float, z: float, ahead: float) -> None:
    passed = walked(Pursuit(name="pursuit", look_ahead_m=ahead), (0.05, y, z), 1e-3)
    sideways = np.linalg.norm(passed[:, 1:], axis=1)
    after = int(np.searchsorted(passed[:, 0] - 0.05, ahead))
    # exp(−1) in the limit of short steps and small offsets: Euler's steps of s contract by (1 − s/look-ahead) each, a
    # little more, and the way to a point that is not straight ahead is longer than the path.
    assert np.exp(-1.45) * sideways[0] - 1e-12 <= sideways[after] <= np.exp(-0.7) * sideways[0] + 1e-12
    assert np.all(np.diff(sideways) <= 1e-12)


@given(x=st.floats(0.01, 0.35), y=offsets, z=offsets)
def test_square_meets_the_path_at_a_right_angle_and_then_goes_along_it(x: float, y: float, z: float) -> None:
    passed = walked(Square(name="square"), (x, y, z))
    away = np.linalg.norm(passed[:, 1:], axis=1)
    returning = np.flatnonzero(away > STEP)
    assert np.array_equal(returning, np.arange(len(returning)))
    # Up to the spacing of the path's points.
    np.testing.assert_allclose(passed[: len(returning) + 1, 0], x, atol=STRAIGHT.places.spacing)
    np.testing.assert_allclose(passed[len(returning) + 4 :, 1:], 0.0, atol=0.05 * STEP)


@settings(max_examples=15)
@given(segment=st.integers(0, 3), y=st.floats(-0.015, 0.015), z=st.floats(-0.015, 0.015))
def test_offsets_from_a_via_point_die_out_with_minimum_jerk_until_the_next(segment: int, y: float, z: float) -> None:
    begin = 0.1 * segment
    passed = walked(Via(name="via", via_points=3), (begin, y, z), 5e-4)
    u = np.clip((passed[:, 0] - begin) / 0.1, 0.0, 1.0)
    wanted = (1.0 - (10 * u**3 - 15 * u**4 + 6 * u**5))[:, None] * [y, z]
    np.testing.assert_allclose(passed[:, 1:], wanted, atol=0.02 * np.hypot(y, z) + 1e-9)
    np.testing.assert_allclose(passed[passed[:, 0] >= begin + 0.1, 1:], 0.0, atol=1e-4)


def test_between_via_points_no_motion_has_less_jerk(shelf_task: ShelfTask) -> None:
    points = shelf_task.reference_path.places.points[::200]
    times, spline = least_jerk(points)
    np.testing.assert_allclose(spline(times), points, atol=1e-12)
    t = np.linspace(times[0], times[-1], 20001)
    jerk = spline(t, 3)

    def squared(values: Array) -> float:
        return float(np.trapezoid((values**2).sum(axis=1), t))

    # Any other motion through the same points differs by one that vanishes at all of them.
    vanishing = np.polynomial.Polynomial.fromroots(times / times[-1])
    rng = np.random.default_rng(0)
    for _ in range(10):
        bump = vanishing * np.polynomial.Polynomial(rng.normal(size=4))
        change = bump.deriv(3)(t / times[-1])[:, None] * rng.normal(size=3)
        for size in (-1e-3, -1e-6, 1e-6, 1e-3):
            scaled = size * change / np.abs(change).max() * np.abs(jerk).max()
            assert squared(jerk + scaled) > squared(jerk)


@pytest.mark.parametrize("count", [1, 50])
def test_a_path_shorter_than_its_via_points_is_passed_too(count: int) -> None:
    short = ReferencePath.along(pose.make([[0.0, 0, 0], [0.01, 0, 0]], UPRIGHT))
    passed = Via(name="via", via_points=count).expert(short, pose.make([0.01, 0, 0], UPRIGHT), STEP, 0.0)
    end = passed.roll_out(pose.make((0.0, 0.002, 0.0), UPRIGHT), 100)[-1]
    np.testing.assert_allclose(end[:3], [0.01, 0, 0], atol=STEP)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_it_passes_its_via_points(shelf_task: ShelfTask, count: int) -> None:
    shown = shelf_task.reference_path
    path = Via(name="via", via_points=count).expert(shown, shelf_task.goal, STEP, 0.0).path.places
    via = shown.places.at(np.linspace(0.0, shown.places.length, count + 2))
    distance = np.linalg.norm(path.points[None] - via[:, None], axis=2).min(axis=1)
    assert distance.max() < path.spacing


def test_one_who_keeps_a_wide_berth_stays_farther_from_the_scene(workcell: Workcell) -> None:
    means, least = {}, {}
    for name in ("pursuit", "wide"):
        cell = open_workcell(load_parts(f"person={name}").task, workcell.arm)
        joints, reason = cell.reachability.follow(cell.task.demonstrator.roll_out(cell.task.nominal_start, 1000))
        assert joints is not None, reason
        clear = np.array([cell.scene.payload_clearance(row) for row in joints])
        between = clear[len(clear) // 8 : -len(clear) // 8]
        means[name], least[name] = between.mean(), between.min()
    assert means["wide"] > means["pursuit"] + 0.003
    assert least["wide"] >= least["pursuit"]


def test_wider_by_nothing_is_the_path_shown(shelf_task: ShelfTask) -> None:
    same = Wide(name="wide", look_ahead_m=0.015, wider=0.0).expert(
        shelf_task.reference_path, shelf_task.goal, STEP, 0.0
    )
    np.testing.assert_allclose(same.path.places.points, shelf_task.reference_path.places.points, atol=1e-4)


@pytest.mark.parametrize("person", PERSONS)
def test_the_arm_follows_each_on_the_shelf(workcell: Workcell, person: str) -> None:
    task = load_parts(f"person={person}").task
    starts, _, _ = workcell.reachability.draw_starts(task, np.random.default_rng(1), 5)
    for start in starts:
        joints, reason = workcell.reachability.follow(task.demonstrator.roll_out(start, 1000))
        assert joints is not None, reason


@pytest.mark.parametrize("person", PERSONS)
def test_a_task_is_read_back_with_its_person(person: str) -> None:
    task = load_parts(f"person={person}").task
    assert load_settings(described(task), Task, "task").person == task.person


class Direct(Person):
    """Heads straight for the goal from everywhere."""

    least_m: float

    def expert(self, shown: ReferencePath, goal: Array, step: float, turn: float) -> Expert:
        return Expert(
            shown, lambda path, positions, arc, step: np.tile(goal[:3], (len(positions), 1)), goal, step, turn
        )


class Nowhere(Person):
    """Aims at no place."""

    def expert(self, shown: ReferencePath, goal: Array, step: float, turn: float) -> Expert:
        return Expert(shown, lambda path, positions, arc, step: positions + np.nan, goal, step, turn)


def test_a_person_who_aims_nowhere_is_refused_by_name(shelf_task: ShelfTask, workcell: Workcell) -> None:
    task = with_fields(shelf_task, person={"target": f"{__name__}.Nowhere", "name": "nowhere"})
    with pytest.raises(BadInputError, match=r"task shelf: person nowhere must aim at finite positions, .* found nan"):
        open_workcell(task, workcell.arm)


def test_a_person_of_ones_own_takes_part_by_target(shelf_task: ShelfTask) -> None:
    node = {"target": f"{__name__}.Direct", "name": "direct", "least_m": 0.1}
    task = with_fields(shelf_task, person=node)
    passed = task.demonstrator.roll_out(task.nominal_start, 1000)[:, :3]
    way = task.goal[:3] - passed[0]
    assert np.linalg.norm(np.cross(passed - passed[0], way / np.linalg.norm(way)), axis=1).max() < 1e-9
    assert load_settings(described(task), Task, "task").person == Direct(name="direct", least_m=0.1)


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("person=via", None),
        ("person.look_ahead_m=0.06", None),
        ("person.look_ahead_m=0", r"person.look_ahead_m: must be greater than or equal to 0.001, found 0"),
        ("+person.look_m=1", r"unknown key person.look_m; valid: look_ahead_m, name"),
        ("person.target=koopdqn.tasks.person.Nobody", "has no class 'Nobody'; valid: .*Pursuit.*Square"),
        ("person.target=koopdqn.tasks.shelf.ShelfTask", "person.target: must name a class that implements .*Person"),
    ],
)
def test_the_command_line_chooses_and_checks_it(override: str, expected: str | None) -> None:
    from koopdqn.app.commands.configuration import Configuration
    from koopdqn.app.hydra.compose import composed

    if expected is None:
        person = Configuration.load(composed([override])).task.person
        assert override in (f"person={person.name}", f"person.look_ahead_m={getattr(person, 'look_ahead_m', None)}")
        return
    with pytest.raises(BadInputError) as caught:
        Configuration.load(composed([override]))
    assert re.search(expected, str(caught.value))
