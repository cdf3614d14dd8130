import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from parts import as_demonstrations

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstration, Demonstrations
from koopdqn.errors import BadInputError
from koopdqn.paths import to_step
from koopdqn.pose import Array


def some_poses(seed: int, count: int = 5) -> Array:
    rng = np.random.default_rng(seed)
    turns = np.cumsum(0.3 * rng.normal(size=(count, 3)), axis=0)
    return pose.make(rng.normal(size=(count, 3)), pose.from_rotation_vector(turns))


TIMES = np.arange(5.0)
GOOD = some_poses(0)


def spoiled(row: int, column: int, value: float) -> Array:
    poses = GOOD.copy()
    poses[row, column] = value
    return poses


@pytest.mark.parametrize(
    ("times", "poses", "joints", "message"),
    [
        (TIMES, GOOD[:, :6], None, r"shape \(N, 7\) with N >= 2, found \(5, 6\)"),
        (TIMES[:1], GOOD[:1], None, r"N >= 2, found \(1, 7\)"),
        (TIMES[:4], GOOD, None, r"times must have shape \(5,\), found \(4,\)"),
        (np.array([0.0, 1, 1, 2, 3]), GOOD, None, "times must increase, found 1 that do not"),
        (np.array([0.0, 2, 1, 0, 3]), GOOD, None, "times must increase, found 2 that do not"),
        (np.array([0.0, 1, 2, 3, np.inf]), GOOD, None, "must be finite"),
        (TIMES, spoiled(2, 1, np.nan), None, "must be finite"),
        (TIMES, np.hstack([GOOD[:, :3], 1.01 * GOOD[:, 3:]]), None, "length 1 within 0.001, found 1.01"),
        (TIMES, GOOD, np.zeros((4, 6)), r"joints must have shape \(5, 6 or more\), found \(4, 6\)"),
        (TIMES, GOOD, np.zeros((5, 5)), r"joints must have shape \(5, 6 or more\), found \(5, 5\)"),
        (TIMES, GOOD, np.full((5, 6), np.nan), "joints must be finite"),
        (TIMES, GOOD, np.zeros(5), "joints must have shape"),
    ],
)
def test_what_is_no_trajectory_is_refused(times: Array, poses: Array, joints: Array | None, message: str) -> None:
    with pytest.raises(BadInputError, match=message):
        Demonstration(times, poses, joints)


def test_arrays_are_copied_and_frozen() -> None:
    times, poses, joints = TIMES.copy(), GOOD.copy(), np.zeros((5, 6))
    item = Demonstration(times, poses, joints)
    times[0], poses[0, 0], joints[0, 0] = -1.0, 9.0, 9.0
    assert item.joints is not None
    assert (item.times[0], item.poses[0, 0], item.joints[0, 0]) == (0.0, GOOD[0, 0], 0.0)
    for values in (item.times, item.poses, item.joints):
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 1.0
    assert len(item) == 5


@given(st.integers(0, 1000), st.lists(st.booleans(), min_size=12, max_size=12))
def test_signs_of_quaternions_become_continuous_and_rotations_stay(seed: int, flips: list[bool]) -> None:
    smooth = some_poses(seed, 12)
    mixed = smooth.copy()
    mixed[flips, 3:] *= -1
    item = Demonstration(np.arange(12.0), mixed)
    assert np.all((item.poses[1:, 3:] * item.poses[:-1, 3:]).sum(axis=1) >= 0)
    assert pose.rotation_distance(item.poses, smooth).max() < 1e-14
    np.testing.assert_array_equal(item.poses[0], mixed[0])


@given(st.integers(0, 1000))
def test_what_was_checked_once_is_not_changed_again(seed: int) -> None:
    once = Demonstration(TIMES, some_poses(seed))
    np.testing.assert_array_equal(Demonstration(once.times, once.poses).poses, once.poses)


def test_nearly_unit_quaternions_become_units() -> None:
    item = Demonstration(TIMES, np.hstack([GOOD[:, :3], 1.0005 * GOOD[:, 3:]]))
    np.testing.assert_allclose(np.linalg.norm(item.poses[:, 3:], axis=1), 1.0, atol=1e-15)


def test_no_demonstrations_are_refused() -> None:
    with pytest.raises(BadInputError, match="at least one demonstration, found none"):
        Demonstrations("shelf", "UR5", [])


def test_the_digest_is_of_everything_that_is_said() -> None:
    two = as_demonstrations("shelf", [GOOD, some_poses(1)])
    later = Demonstration(TIMES + 1, GOOD)
    others = [
        as_demonstrations("knife", [GOOD, some_poses(1)]),
        as_demonstrations("shelf", [some_poses(1), GOOD]),
        as_demonstrations("shelf", [GOOD]),
        as_demonstrations("shelf", [GOOD, some_poses(2)]),
        Demonstrations("shelf", "UR3", two.items),
        Demonstrations("shelf", "UR5", [later, two.items[1]]),
        Demonstrations("shelf", "UR5", [Demonstration(TIMES / 10, GOOD, np.zeros((5, 6))), two.items[1]]),
    ]
    assert two.digest() == as_demonstrations("shelf", [GOOD, some_poses(1)]).digest()
    assert len({two.digest(), *(other.digest() for other in others)}) == 1 + len(others)


def test_resampled_poses_are_made_once_and_stay_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    demonstrations = as_demonstrations("shelf", [GOOD, some_poses(1)])
    expected = to_step([GOOD, some_poses(1)], 0.1, 0.2)
    first = demonstrations.resampled(0.1, 0.2)
    for got, wanted in zip(first, expected, strict=True):
        np.testing.assert_array_equal(got, wanted)
    with pytest.raises(ValueError, match="read-only"):
        first[0][0] = 0.0
    first.pop()
    monkeypatch.setattr("koopdqn.demonstrations.dataset.to_step", lambda *given: pytest.fail("made again"))
    assert len(demonstrations.resampled(0.1, 0.2)) == 2
    with pytest.raises(pytest.fail.Exception):
        demonstrations.resampled(0.1, 0.3)
