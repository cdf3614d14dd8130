from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from koopdqn.rl.replay_buffer import BATCH_FIELDS, FIELDS, ReplayBuffer, Transitions


def numbered(numbers: list[int]) -> Transitions:
    """Transitions whose every field tells their number."""
    n = np.array(numbers, dtype=np.int64)
    column = n.astype(np.float32)
    return Transitions(
        observations=np.stack([column, -column], axis=1),
        actions=n % 10,
        rewards=(column / 2).astype(np.float32),
        next_observations=np.stack([column + 0.5, column], axis=1),
        terminated=n % 2 == 0,
        truncated=n % 3 == 0,
        undone=n % 5 == 0,
        poses=np.repeat(n[:, None] / 8, 7, axis=1),
        starts=np.repeat(n[:, None] / 16, 7, axis=1),
        steps=n + 1,
        sources=n % 4,
        answers=n - 3,
    )


def filled(capacity: int, sizes: list[int]) -> ReplayBuffer:
    buffer, done = ReplayBuffer(capacity, 2), 0
    for size in sizes:
        buffer.add(numbered(list(range(done, done + size))))
        done += size
    return buffer


def held(buffer: ReplayBuffer) -> set[int]:
    return {int(number) for number in buffer.state()["observations"][:, 0]}


sizes_lists = st.lists(st.integers(0, 9), min_size=1, max_size=8)


@given(capacity=st.integers(1, 12), sizes=sizes_lists)
def test_the_newest_are_kept_and_the_oldest_go(capacity: int, sizes: list[int]) -> None:
    buffer, total = filled(capacity, sizes), sum(sizes)
    assert buffer.added == total
    assert len(buffer) == min(total, capacity)
    assert held(buffer) == set(range(max(0, total - capacity), total))


@given(capacity=st.integers(1, 12), sizes=sizes_lists.filter(sum), seed=st.integers(0, 100))
def test_fields_of_a_transition_stay_together(capacity: int, sizes: list[int], seed: int) -> None:
    drawn = filled(capacity, sizes).sample(np.random.default_rng(seed), 50)
    wanted = numbered([int(number) for number in drawn.observations[:, 0]])
    for name in BATCH_FIELDS:
        np.testing.assert_array_equal(getattr(drawn, name), getattr(wanted, name))
        assert getattr(drawn, name).dtype == getattr(wanted, name).dtype


def test_every_held_transition_is_drawn_about_equally_often() -> None:
    drawn = filled(10, [7, 6]).sample(np.random.default_rng(0), 20_000).observations[:, 0]
    numbers, counts = np.unique(drawn, return_counts=True)
    np.testing.assert_array_equal(numbers, np.arange(3, 13))
    assert counts == pytest.approx(2000, rel=0.1)


def tried(sizes: list[int]) -> Transitions:
    """Transitions of which so many were tried from each of as many states."""
    made = numbered(list(range(sum(sizes))))
    return replace(made, poses=np.repeat(np.arange(len(sizes), dtype=float)[:, None], 7, axis=1).repeat(sizes, axis=0))


@given(
    capacity=st.integers(1, 60),
    sizes=st.lists(st.integers(1, 10), min_size=1, max_size=12),
    count=st.integers(1, 20),
    seed=st.integers(0, 100),
)
def test_a_drawn_state_comes_whole_and_together(capacity: int, sizes: list[int], count: int, seed: int) -> None:
    buffer, data = ReplayBuffer(capacity, 2), tried(sizes)
    buffer.add(data)
    drawn = buffer.sample_states(np.random.default_rng(seed), count)
    numbers = drawn.observations[:, 0].astype(int)
    for name in BATCH_FIELDS:
        np.testing.assert_array_equal(getattr(drawn, name), getattr(data, name)[numbers])
    held, begin, states = buffer.held(), 0, 0
    while begin < len(numbers):
        wanted = held.observations[(held.poses == data.poses[numbers[begin]]).all(axis=1), 0].astype(int)
        assert set(numbers[begin : begin + len(wanted)]) == set(wanted)
        begin, states = begin + len(wanted), states + 1
    assert states == count


@given(capacity=st.integers(1, 12), sizes=sizes_lists.filter(sum), more=st.integers(0, 15))
def test_a_restored_buffer_goes_on_as_the_old_one(capacity: int, sizes: list[int], more: int) -> None:
    old, new = filled(capacity, sizes), ReplayBuffer(capacity, 2)
    new.restore({name: values.copy() for name, values in old.state().items()})
    for buffer in (old, new):
        buffer.add(numbered(list(range(500, 500 + more))))
    assert new.added == old.added
    for name in FIELDS:
        np.testing.assert_array_equal(new.state()[name], old.state()[name])
    one, two = (buffer.sample(np.random.default_rng(1), 20) for buffer in (old, new))
    np.testing.assert_array_equal(one.observations, two.observations)


def test_the_state_is_a_copy() -> None:
    buffer = filled(4, [3])
    buffer.state()["rewards"][:] = 99
    assert buffer.sample(np.random.default_rng(0), 30).rewards.max() < 99


@given(capacity=st.integers(1, 12), sizes=sizes_lists, gone=st.sets(st.integers(0, 71)), more=st.integers(0, 15))
def test_removing_keeps_order_and_content_of_the_others(
    capacity: int, sizes: list[int], gone: set[int], more: int
) -> None:
    buffer, total = filled(capacity, sizes), sum(sizes)
    newest = range(max(0, total - capacity), total)
    kept = [number for number in newest if number not in gone]
    buffer.remove(np.isin(buffer.held().observations[:, 0], list(gone)))
    wanted = numbered(kept)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(buffer.held(), name), getattr(wanted, name))
    # It goes on as a buffer that never held the others: the oldest still go first.
    buffer.add(numbered(list(range(500, 500 + more))))
    assert held(buffer) == set([*kept, *range(500, 500 + more)][-capacity:] if more or kept else [])


@pytest.mark.parametrize("step_back", [True, False])
def test_other_rewards_change_what_follows_from_their_sign_and_nothing_else(step_back: bool) -> None:
    buffer = filled(10, [8])
    before, rows = buffer.held(), np.array([1, 2, 5, 6])
    rewards, at_goal = np.array([1.0, -1.0, -0.5, 0.0], np.float32), np.array([True, True, False, False])
    buffer.revalue(rows, rewards, at_goal, step_back=step_back)
    after, others = buffer.held(), np.setdiff1d(np.arange(8), rows)
    np.testing.assert_array_equal(after.rewards[rows], rewards)
    np.testing.assert_array_equal(after.terminated[rows], [True, not step_back, False, False])
    np.testing.assert_array_equal(after.undone[rows], [False, step_back, step_back, False])
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(after, name)[others], getattr(before, name)[others])
        if name not in ("rewards", "terminated", "undone"):
            np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
