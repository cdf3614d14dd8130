"""The task made from demonstrations: what is derived, its expert, its starts."""

import numpy as np
import pytest
from helpers_shown import HORIZONTAL, arc, derivation, recorded, shown, tipping, turned_by
from hypothesis import given, settings
from hypothesis import strategies as st
from parts import Parts, load_parts

from koopdqn import pose
from koopdqn.artifact import described
from koopdqn.demonstrations.derivation import Derived
from koopdqn.demonstrations.generate import generate
from koopdqn.errors import BadInputError
from koopdqn.intent.fit import fit
from koopdqn.paths import arc_lengths
from koopdqn.pose import Array
from koopdqn.settings import load_settings
from koopdqn.tasks.person import Expert, Pursuit, ReferencePath
from koopdqn.tasks.task import Task

RECIPE = derivation()
AHEAD = 0.015


def three() -> Derived:
    return RECIPE.derive(shown(*(recorded(arc(offset), idle=40) for offset in (0.0, 0.02, 0.04))))


def test_the_last_demonstration_shapes_nothing() -> None:
    derived = three()
    alone = RECIPE.model_copy(update={"holdout": 0}).derive(
        shown(recorded(arc(), idle=40), recorded(arc(0.02), idle=40))
    )
    assert len(derived.training) == 2
    assert len(derived.held_out) == 1
    assert derived.training.digest() == alone.training.digest()
    np.testing.assert_allclose(derived.held_out[0].poses[0, :3], arc(0.04)[0, :3], atol=1e-4)


def test_start_goal_step_and_rule_are_those_shown() -> None:
    task = three().task
    np.testing.assert_allclose(task.goal[:3], arc()[-1, :3], atol=1e-4)
    assert task.turning == "held"
    assert task.orientation == "held"
    assert task.step_m == 0.0021
    assert not task.rule_broken(arc()).any()
    assert task.rule_broken(turned_by(arc(), 0.5))[:10].all()


def test_what_a_held_out_demonstration_does_otherwise_is_a_remark() -> None:
    elsewhere, turned = arc(0.04), arc(0.04)
    elsewhere[:, 1] += 0.3
    turned[:, 3:] = pose.multiply(HORIZONTAL, pose.from_rotation_vector([0.0, 0.0, 0.5 * np.pi]))
    found: dict[int, list[str]] = {}
    for last in (arc(0.04), elsewhere, turned, arc(0.04)[:100]):
        derived = RECIPE.derive(shown(recorded(arc()), recorded(arc(0.02)), recorded(last)))
        found[len(found)] = [note for note in derived.notes if "demonstration 2" in note]
        np.testing.assert_allclose(np.abs(derived.held_out[0].poses[:, 3:] @ last[0, 3:]), 1.0)
    assert found[0] == []
    for index, words in enumerate(("300 mm from the goal", "turned 90°", "mm from the goal"), 1):
        assert words in found[index][0]
    free = RECIPE.model_copy(update={"turning": "free"})
    derived = free.derive(shown(recorded(arc()), recorded(arc(0.02)), recorded(turned)))
    assert not any("demonstration 2" in note for note in derived.notes)
    np.testing.assert_allclose(derived.held_out[0].poses[:, 3:], derived.training.items[0].poses[:, 3:], atol=1e-9)


def test_one_demonstration_is_enough_and_said_to_be_one() -> None:
    derived = RECIPE.derive(shown(recorded(arc())))
    assert derived.held_out == ()
    assert any("one demonstration" in note for note in derived.notes)
    assert not any("one demonstration" in note for note in three().notes)


def test_an_odd_one_is_said_to_be_odd() -> None:
    items = [recorded(arc(0.003 * index)) for index in range(6)]
    bulge = arc()
    bulge[:, 2] += 0.1 * np.sin(np.linspace(0.0, np.pi, len(bulge))) ** 4
    odd = RECIPE.model_copy(update={"holdout": 0}).derive(shown(*items[:2], recorded(bulge), *items[2:]))
    assert [note[:16] for note in odd.notes if "the trust domain reaches" in note] == ["demonstration 2 "]
    assert not any("the trust domain reaches" in note for note in three().notes)


def test_two_ways_are_told() -> None:
    items = []
    for index in range(5):
        poses = arc(0.004 * index)
        poses[:, 0] += (0.06 if index % 2 else -0.06) * np.sin(np.linspace(0.0, np.pi, len(poses)))
        items.append(recorded(poses))
    notes = RECIPE.derive(shown(*items)).notes
    assert any("go two ways (0, 2 and 1, 3)" in note for note in notes)


def test_a_jump_that_stays_is_told() -> None:
    poses = arc()
    poses[100:, 0] += 0.15
    notes = RECIPE.derive(shown(recorded(poses))).notes
    assert any("demonstration 0 jumps by 150 mm" in note for note in notes)
    held_out = RECIPE.derive(shown(recorded(arc()), recorded(poses)))
    assert not any("jumps" in note for note in held_out.notes)


@pytest.mark.parametrize("half", [(0.0, 0.0, 0.0), (-0.1, 0.1, 0.1)])
def test_a_region_of_goals_that_is_none_is_bad_input(half: tuple[float, float, float]) -> None:
    with pytest.raises(
        BadInputError, match=r"^task demonstrated: .*goal_half_range_m must not be negative, and above 0"
    ):
        RECIPE.model_copy(update={"goal_half_range_m": half}).derive(shown(recorded(arc()), recorded(arc(0.01))))


def test_a_turn_that_is_to_be_held_is_left_out_of_what_is_held_out_too() -> None:
    items = [recorded(turned_by(arc(0.01 * index), 1.0)) for index in range(3)]
    made = RECIPE.model_copy(update={"turning": "held"}).derive(shown(*items))
    assert any("held, the goal's is kept and what was demonstrated left out" in note for note in made.notes)
    [aside] = made.held_out
    assert not made.task.rule_broken(aside.poses).any()


@pytest.mark.parametrize("holdout", [1, 5])
def test_something_must_be_left_to_learn_from(holdout: int) -> None:
    with pytest.raises(BadInputError, match=rf"task.holdout .* found {holdout} of 1"):
        RECIPE.model_copy(update={"holdout": holdout}).derive(shown(recorded(arc())))


def test_orientation_is_told_apart() -> None:
    wobble = arc()
    wobble[:, 3:] = pose.multiply(
        HORIZONTAL, pose.from_rotation_vector(0.3 * np.sin(np.linspace(0, 9, 200))[:, None] * [0.0, 1.0, 0.0])
    )
    shapes = {"held": arc(), "geodesic": turned_by(arc(), 1.5), "wobbling": wobble}
    found = {name: RECIPE.derive(shown(recorded(poses))).task for name, poses in shapes.items()}
    turnings = {name: task.turning for name, task in found.items()}
    assert turnings == {"held": "held", "geodesic": "geodesic", "wobbling": "geodesic"}
    assert found["geodesic"].orientation == "learned"
    in_full = {name: RECIPE.derive(shown(recorded(poses)), continuous=True).task for name, poses in shapes.items()}
    assert {name: task.turning for name, task in in_full.items()} == {
        "held": "held",
        "geodesic": "full",
        "wobbling": "full",
    }
    assert in_full["wobbling"].orientation == "learned"
    free = RECIPE.model_copy(update={"turning": "free"}).derive(shown(recorded(wobble))).task
    assert free.orientation == "held"
    assert not free.rule_broken(wobble).any()


def test_what_turns_straight_from_starts_turned_apart_is_no_full_turn() -> None:
    apart = shown(*(recorded(turned_by(arc(), angle)) for angle in (-1.0, -0.4, 0.4, 1.0)))
    assert RECIPE.derive(apart, continuous=True).task.turning == "geodesic"
    alike = shown(*(recorded(tipping(offset)) for offset in (0.0, 0.01, 0.02)))
    assert RECIPE.derive(alike, continuous=True).task.turning == "full"


def test_ten_actions_do_not_turn_in_full() -> None:
    recipe = RECIPE.model_copy(update={"turning": "full"})
    with pytest.raises(BadInputError, match="full must go with actions=continuous, found the ten actions"):
        recipe.derive(shown(recorded(turned_by(arc(), 1.5))))
    to_goal = RECIPE.model_copy(update={"turning": "geodesic"})
    assert to_goal.derive(shown(recorded(turned_by(arc(), 1.5))), continuous=True).task.turning == "geodesic"


def test_what_tips_and_turns_back_is_done_by_the_person_and_foretold_in_full(parts: Parts) -> None:
    derived = RECIPE.model_copy(update={"holdout": 0}).derive(shown(recorded(tipping())), continuous=True)
    task = derived.task
    model = parts.intent.fit(task.person_frame.each(task.trajectories), task)
    model = parts.intent.restore(model.arrays())
    begun = task.trajectories[0][:1]
    for path in (task.demonstrator.roll_out(begun[0], 800), model.intended_paths(begun, 800, task.step_m)[:, 0]):
        assert np.degrees(pose.rotation_distance(path, task.goal).max()) == pytest.approx(40, abs=3)
        assert np.degrees(pose.rotation_distance(path[-1], task.goal)) < 1
        assert pose.position_distance(path[-1], task.goal) < 0.001


def test_turns_that_ten_actions_leave_out_are_told() -> None:
    tipped = shown(recorded(tipping()), recorded(tipping(0.02)))
    geodesic = RECIPE.model_copy(update={"turning": "geodesic"})
    told = "turn up to 40° farther from the goal's orientation on their way than they begin"
    assert told in " ".join(geodesic.derive(tipped).notes)
    assert told not in " ".join(RECIPE.derive(tipped, continuous=True).notes)
    straight = shown(recorded(turned_by(arc(), 1.5)))
    assert "farther from the goal's orientation" not in " ".join(geodesic.derive(straight).notes)


def test_the_turn_of_the_knife_is_learned_from_its_demonstrations() -> None:
    from hydra import compose, initialize_config_dir

    from koopdqn.resources import conf_dir
    from koopdqn.tasks.workcell import open_workcell

    parts = load_parts()

    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        knife = load_settings(compose("config", overrides=["task=knife"]).task, Task, "task")
    cell = open_workcell(knife, parts.arm)
    made = generate(knife, cell.reachability, parts.demo.model_copy(update={"count": 2}), seed=0).demonstrations
    task = RECIPE.derive(made).task
    assert task.turning == "geodesic"
    assert pose.position_distance(task.goal, knife.goal) < 0.002
    path = task.demonstrator.roll_out(task.trajectories[0][0], 800)
    assert pose.rotation_distance(path[-1], task.goal) < 1e-6
    assert pose.position_distance(path[-1], task.goal) < 1e-6


def test_starts_lie_beside_demonstrated_ones_and_off_the_goal() -> None:
    task = three().task
    drawn = task.draw_starts(np.random.default_rng(0), 200)
    starts = np.array([trajectory[0] for trajectory in task.trajectories])
    apart = np.abs(drawn[:, None, :3] - starts[None, :, :3]).max(axis=2).min(axis=1)
    assert apart.max() <= task.start_margin_m
    assert pose.position_distance(drawn, task.goal).min() > task.goal_tolerance_m
    assert np.all(np.abs(drawn[:, :3] - task.nominal_start[:3]) <= np.array(task.start_half_range_m) + 1e-12)


def test_a_demonstration_that_begins_at_the_goal_is_refused() -> None:
    short = arc()[:10]
    assert 0.01 < arc_lengths(short[:, :3])[-1] < 0.02
    with pytest.raises(BadInputError, match=r"demonstration 0 must start at least 0\.02 m from the goal"):
        RECIPE.derive(shown(recorded(short)))


def test_what_only_turns_is_called_so_and_what_closes_is_taken() -> None:
    loops, turn = [], turned_by(np.tile(arc()[:1], (200, 1)), 1.5)
    for index, end in enumerate(([0.03, 0.0, 0.0], [-0.03, 0.0, 0.0], [0.0, 0.0, 0.03])):
        loop = np.concatenate([arc(), arc()[::-1]])
        loop[:, :3] += np.linspace(0.0, 1.0, len(loop))[:, None] * end
        loops.append(recorded(loop, seed=index))
    assert RECIPE.model_copy(update={"holdout": 0}).derive(shown(*loops)).task.passes_itself
    with pytest.raises(BadInputError, match=r"turn only in place, never more than 0\.0 mm"):
        RECIPE.derive(shown(recorded(turn), recorded(turn)))


def test_ends_far_apart_are_refused() -> None:
    moved = arc()
    moved[:, 1] += 0.3
    with pytest.raises(BadInputError, match="share their goal"):
        RECIPE.derive(shown(recorded(arc()), recorded(moved), recorded(arc())))


def test_artifacts_hold_the_task_without_its_demonstrations() -> None:
    task = three().task
    node = described(task)
    assert len(str(node)) < 2000
    read = load_settings(node, Task, "task")
    assert described(read) == node
    with pytest.raises(BadInputError, match="must come with its demonstrations"):
        read.demonstrator  # noqa: B018 (the property raises)
    other = RECIPE.derive(shown(recorded(arc(0.001)), recorded(arc(0.02)))).task
    assert described(other) != node


def test_a_short_demonstration_has_a_shorter_step() -> None:
    small = arc()
    small[:, :3] = small[-1, :3] + 0.2 * (small[:, :3] - small[-1, :3])
    task = RECIPE.derive(shown(recorded(small))).task
    assert task.step_m < 0.0021
    assert 1.0 < task.step_m / task.position_tolerance_m <= 1.087


@settings(max_examples=20)
@given(
    index=st.integers(0, 120),
    demonstration=st.integers(0, 1),
    offset=st.lists(st.floats(-0.03, 0.03), min_size=3, max_size=3),
)
def test_the_expert_comes_to_the_goal_along_a_demonstration(
    index: int, demonstration: int, offset: list[float]
) -> None:
    task = LAW_TASK
    start = task.trajectories[demonstration][index].copy()
    start[:3] += offset
    path = task.demonstrator.roll_out(start, 500)
    assert pose.position_distance(path[-1], task.goal) < 1e-6
    assert np.all(pose.position_distance(path[1:], path[:-1]) <= task.step_m * (1 + 1e-9))
    points = np.concatenate([trajectory[:, :3] for trajectory in task.trajectories])
    gap = np.linalg.norm(path[:, None, :3] - points[None], axis=2).min(axis=1)
    # After some look-ahead distances on the way the offset has died out.
    settled = int(6 * AHEAD / task.step_m) + int(2 * np.linalg.norm(offset) / task.step_m)
    assert gap[settled:].max(initial=0.0) < 0.0025


LAW_TASK = three().task


def pursuing(poses: Array, step: float, turn: float) -> Expert:
    """Return the expert of pursuing the path along poses (N, 7)."""
    return Pursuit(name="pursuit", look_ahead_m=AHEAD).expert(ReferencePath.along(poses), poses[-1], step, turn)


def test_the_expert_ends_although_its_path_crosses_itself() -> None:
    angle = np.linspace(0.0, 1.75 * np.pi, 300)
    loop = np.stack([np.full(300, 0.45), 0.1 * np.sin(2 * angle), 0.35 + 0.1 * np.sin(angle)], axis=1)
    poses = pose.make(loop, HORIZONTAL)
    expert = pursuing(poses, 0.0021, 0.0)
    path = expert.roll_out(poses[0], 2000)
    assert pose.position_distance(path[-1], poses[-1]) < 1e-6


def test_turning_in_place_is_followed() -> None:
    moved = turned_by(arc(count=100), 0.0)
    still = np.repeat(moved[-1:], 60, axis=0)
    before = turned_by(still, 1.0)
    moved[:, 3:] = before[0, 3:]
    poses = np.concatenate([moved, before])[1::2]
    expert = pursuing(poses, 0.0063, 0.02)
    path = expert.roll_out(poses[0], 500)
    assert pose.rotation_distance(path[-1], poses[-1]) < 1e-6
    arrived = int((pose.position_distance(path, poses[-1]) < 0.01).argmax())
    assert pose.rotation_distance(path[arrived], poses[-1]) > 0.8


def test_held_out_demonstrations_keep_their_own_end() -> None:
    moved = arc()
    moved[:, 1] += 0.01
    derived = RECIPE.derive(shown(recorded(arc()), recorded(arc()), recorded(moved)))
    assert pose.position_distance(derived.held_out[0].poses[-1], derived.task.goal) == pytest.approx(0.01, abs=1e-4)


def test_what_does_not_turn_can_be_learned_with_its_turn() -> None:
    derived = derivation(turning="geodesic").derive(shown(*(recorded(arc(offset)) for offset in (0.0, 0.01, 0.02))))
    parts = load_parts("intent.count=100")
    report = fit(derived.training, derived.task, parts.intent, parts.trust, parts.reward).report
    assert report["sixty_samples"]["rms_over_persistence_rotation"] is None
