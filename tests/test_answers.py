import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.rl.answers import FeedbackSettings, RememberedAnswers

NEAR, TURN, ACTIONS = 0.002, 0.05, 10
MARGINS = [-0.6, -0.1, 0.0, 0.2, 0.7]
SETTINGS = FeedbackSettings(remember_m=NEAR, remember_rad=TURN, extend=True, reach_m=0.015)
HERE = np.array([0.4, -0.2, 0.5, 1.0, 0.0, 0.0, 0.0])


def beside(x: float, turn: float = 0.0) -> Array:
    """Return the pose (7,) that is ``x`` times as far beside :data:`HERE` as answers hold, and turned alike."""
    return pose.make(HERE[:3] + np.array([x * NEAR, 0.0, 0.0]), pose.from_rotation_vector([0.0, 0.0, turn * TURN]))


# Place, turn, action, answer, and the margin of the model's opinion when it was asked.
given_answers = st.lists(
    st.tuples(
        st.sampled_from([-1.5, -0.5, 0.0, 0.25, 0.5, 2.0]),
        st.sampled_from([0.0, 0.5, 1.5]),
        st.integers(4, 6),
        st.booleans(),
        st.sampled_from(MARGINS),
    ),
    max_size=12,
)


def memory_of(answers: list[tuple[float, float, int, bool, float]]) -> RememberedAnswers:
    memory = RememberedAnswers(SETTINGS)
    for number, (x, turn, action, right, margin) in enumerate(answers):
        memory.add(
            3 * number,
            beside(x, turn),
            action,
            beside(x + 1.0, turn),
            right=right,
            margin=margin,
            expected=margin >= 0,
        )
    return memory


def assert_same(one: RememberedAnswers, two: RememberedAnswers) -> None:
    assert one.state().keys() == two.state().keys()
    for name, values in one.state().items():
        np.testing.assert_array_equal(values, two.state()[name], err_msg=name)
        assert values.dtype == two.state()[name].dtype


@given(answers=given_answers, x=st.floats(-3, 3), turn=st.floats(0, 2), opinion=st.sampled_from(MARGINS))
def test_the_nearest_answer_that_holds_is_recalled_and_of_equally_near_ones_the_latest(
    answers: list[tuple[float, float, int, bool, float]], x: float, turn: float, opinion: float
) -> None:
    asked = beside(x, turn)
    found = memory_of(answers).recall(asked[None], np.full((1, ACTIONS), opinion))[0]
    for action in range(ACTIONS):
        holding = []
        for place, (other, turned, about, right, margin) in enumerate(answers):
            moved = float(pose.position_distance(asked, beside(other, turned)))
            rotated = float(pose.rotation_distance(asked, beside(other, turned)))
            as_sure = opinion >= margin if right else opinion <= margin
            same = moved <= 1e-6 and rotated <= 1e-6
            if about == action and moved <= NEAR and rotated <= TURN and (as_sure or same):
                holding.append((moved, -place))
        assert found[action] == (-min(holding)[1] if holding else -1)


def test_an_answer_holds_for_what_the_model_thinks_at_least_as_surely() -> None:
    memory = memory_of([(0.0, 0.0, 4, True, 0.3), (0.0, 0.0, 5, False, 0.1), (0.0, 0.0, 6, True, -0.2)])
    opinions = np.array([0.3, 0.29, 0.1, 0.11, -0.2, -0.21, 0.9, -0.9])
    found = memory.recall(np.repeat(beside(0.5)[None], len(opinions), axis=0), np.tile(opinions[:, None], ACTIONS))
    assert (found[:, 4] >= 0).tolist() == [True, False, False, False, False, False, True, False]
    assert (found[:, 5] >= 0).tolist() == [False, False, True, False, True, True, False, True]
    assert (found[:, 6] >= 0).tolist() == [True, True, True, True, True, False, True, False]


def test_at_its_own_pose_an_answer_holds_whatever_the_model_thinks_now() -> None:
    memory = memory_of([(0.0, 0.0, 4, True, 0.3), (0.0, 0.0, 5, False, -0.3)])
    for opinion in (-9.0, 9.0):
        assert memory.recall(HERE[None], np.full((1, ACTIONS), opinion))[0, 4:6].tolist() == [0, 1]


def test_every_pose_is_recalled_for_itself() -> None:
    memory = memory_of([(0.0, 0.0, 4, True, 0.5), (2.0, 0.0, 5, False, 0.5)])
    poses = np.array([beside(0.5), beside(1.5), beside(0.0, 2.0), beside(9.0)])
    found = memory.recall(poses, np.full((4, ACTIONS), 0.5))
    assert found.shape == (4, ACTIONS)
    assert {tuple(item) for item in np.argwhere(found >= 0)} == {(0, 4), (1, 5)}
    assert (found[0, 4], found[1, 5]) == (0, 1)


def test_without_a_radius_nothing_is_recalled() -> None:
    memory = RememberedAnswers(SETTINGS.model_copy(update={"remember_m": 0.0}))
    memory.add(0, HERE, 4, beside(1.0), right=True, margin=0.5, expected=True)
    assert (memory.recall(HERE[None], np.zeros((1, ACTIONS))) == -1).all()


@given(answers=given_answers, gone=st.sets(st.integers(0, 12)))
def test_withdrawing_forgets_exactly_the_answers_of_those_numbers(
    answers: list[tuple[float, float, int, bool, float]], gone: set[int]
) -> None:
    memory = memory_of(answers)
    memory.withdraw({3 * number for number in gone})
    rest = RememberedAnswers(SETTINGS)
    for number, (x, turn, action, right, margin) in enumerate(answers):
        if number not in gone:
            there, expected = beside(x + 1.0, turn), margin >= 0
            rest.add(3 * number, beside(x, turn), action, there, right=right, margin=margin, expected=expected)
    assert_same(memory, rest)


@given(answers=given_answers, x=st.floats(-3, 3))
def test_a_contradiction_forgets_the_noes_nearby_and_no_other_answer(
    answers: list[tuple[float, float, int, bool, float]], x: float
) -> None:
    memory = memory_of(answers)
    memory.contradict(beside(x))
    kept = [
        3 * number
        for number, (other, _, _, right, _) in enumerate(answers)
        if right or pose.position_distance(beside(x), beside(other)) > NEAR
    ]
    assert memory.numbers == kept
    assert memory.contradictions == int(len(kept) < len(answers))


@given(answers=given_answers)
def test_an_extension_tells_the_yeses_that_the_model_expected_from_the_others(
    answers: list[tuple[float, float, int, bool, float]],
) -> None:
    expected, before, after = memory_of(answers).extension()
    wanted = [beside(x, turn) for x, turn, _, right, margin in answers if right and margin >= 0]
    np.testing.assert_array_equal(expected, np.array(wanted).reshape(-1, 7))
    unexpected = [(x, turn) for x, turn, _, right, margin in answers if right and margin < 0]
    np.testing.assert_array_equal(before, np.array([beside(*item) for item in unexpected]).reshape(-1, 7))
    np.testing.assert_array_equal(after, np.array([beside(x + 1.0, turn) for x, turn in unexpected]).reshape(-1, 7))


@given(answers=given_answers, x=st.floats(-3, 3))
def test_a_restored_memory_is_the_same_and_goes_on_alike(
    answers: list[tuple[float, float, int, bool, float]], x: float
) -> None:
    old, new = memory_of(answers), RememberedAnswers(SETTINGS)
    new.restore({name: values.copy() for name, values in old.state().items()})
    assert_same(old, new)
    for memory in (old, new):
        memory.add(99, beside(x), 4, beside(x + 1.0), right=False, margin=0.4, expected=True)
        memory.contradict(beside(0.0))
        memory.withdraw({3})
    assert_same(old, new)
    poses = np.array([beside(x), beside(0.1)])
    margins = np.zeros((2, ACTIONS))
    np.testing.assert_array_equal(old.recall(poses, margins), new.recall(poses, margins))


@pytest.mark.parametrize("right", [True, False])
def test_what_is_remembered_is_a_fact_of_its_own_time(right: bool) -> None:
    memory = memory_of([(0.0, 0.0, 4, right, 0.2)])
    held = memory.state()
    held["poses"][:] = 0.0
    assert memory.recall(HERE[None], np.full((1, ACTIONS), 0.2))[0, 4] == 0


def test_without_memory_nothing_contradicts() -> None:
    memory = RememberedAnswers(SETTINGS.model_copy(update={"remember_m": 0.0}))
    memory.add(0, HERE, 4, beside(1.0), right=False, margin=0.5, expected=True)
    assert memory.contradict(HERE)
    assert memory.contradictions == 0


def test_a_place_is_hopeless_only_where_a_person_said_no_and_until_an_answer_is_withdrawn() -> None:
    memory = RememberedAnswers(SETTINGS)
    memory.contradict(HERE)
    assert not memory.hopeless_near(HERE, 10.0)
    memory.add(0, HERE, 4, beside(1.0), right=False, margin=0.5, expected=True)
    memory.contradict(HERE)
    assert memory.hopeless_near(HERE, 0.001)
    assert not memory.hopeless_near(beside(100.0), 0.001)
    memory.withdraw({7})
    assert not memory.hopeless_near(HERE, 10.0)
