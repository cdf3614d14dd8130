import json

import numpy as np
import pytest
from parts import Parts

from koopdqn.intent.reward import ASKED, REMEMBERED, RULE, TRUSTED, IntentReward
from koopdqn.pose import Array
from koopdqn.rl.checks import Check, Checker, History
from koopdqn.tasks.rollout import Controller
from koopdqn.tasks.workcell import Workcell


def some_history() -> History:
    history = History([1.5, -2.0], [3, 4], [True, False], [0.25], [Check(250, 1000, 9, 0.5, 3.5, {"collision": 10})])
    history.labelled[[RULE, TRUSTED, ASKED, REMEMBERED]] = [7, 8, 4, 5]
    history.agreed[[RULE, TRUSTED, ASKED, REMEMBERED]] = [0, 6, 4, 2]
    return history


def test_it_comes_back_through_json_and_goes_on() -> None:
    restored = History.restored(json.loads(json.dumps(some_history().state())))
    assert restored.state() == some_history().state()
    restored.labelled[ASKED] += 1
    assert restored.checks[0] == Check(250, 1000, 9, 0.5, 3.5, {"collision": 10})
    assert restored.labelled.dtype == some_history().labelled.dtype


def test_what_it_came_from_stays_as_it_was() -> None:
    state = some_history().state()
    History.restored(state).rewards.append(9.0)
    assert state == some_history().state()


def test_agreement_is_the_share_of_each_source_but_rules() -> None:
    assert some_history().agreement() == {
        "trusted": 0.75,
        "asked": 1.0,
        "remembered": 0.4,
        "certified": None,
    }
    assert some_history().counts() == {"trusted": 8, "asked": 4, "remembered": 5, "certified": 0}


def test_where_no_reward_was_given_there_is_no_share() -> None:
    assert History().agreement() == dict.fromkeys(("trusted", "asked", "remembered", "certified"))
    assert History().counts() == dict.fromkeys(("trusted", "asked", "remembered", "certified"), 0)


def test_two_histories_share_nothing() -> None:
    one, two = History(), History()
    one.rewards.append(1.0)
    one.labelled[0] += 1
    assert two.rewards == []
    np.testing.assert_array_equal(two.labelled, 0)


UP = 8
"""Table 1's action along +z."""


def over_the_top(nearest: Controller, height_m: float) -> Controller:
    """Return a controller that goes up at first, over a place it remembers, and then takes the nearest actions."""
    risen: set[bytes] = set()

    def choose(poses: Array, starts: Array) -> np.ndarray:
        actions = nearest(poses, starts)
        for row, (pose, start) in enumerate(zip(poses, starts, strict=True)):
            if start.tobytes() not in risen and pose[2] - start[2] < height_m:
                actions[row] = UP
            else:
                risen.add(start.tobytes())
        return actions

    return choose


@pytest.fixture(scope="module")
def checker(workcell: Workcell, reward: IntentReward, parts: Parts) -> Checker:
    return Checker(workcell, reward.model, parts.train, 900)


@pytest.mark.parametrize(("height_m", "another"), [(0.0, False), (0.004, False), (0.07, True)])
def test_a_way_over_the_top_is_another_way(
    checker: Checker, reward: IntentReward, height_m: float, another: bool
) -> None:
    policy = over_the_top(reward.nearest_actions, height_m)
    rate, goes_another_way = checker.confirm(policy, reward.nearest_actions)
    assert rate > 0.2
    assert goes_another_way is another


def test_of_failures_no_way_is_told(checker: Checker, reward: IntentReward) -> None:
    assert checker.confirm(lambda poses, starts: np.full(len(poses), UP), reward.nearest_actions) == (0.0, False)


def test_other_starts_confirm_than_those_of_the_checks(checker: Checker, reward: IntentReward) -> None:
    seen: list[Array] = []

    def watched(poses: Array, starts: Array) -> np.ndarray:
        seen.append(starts)
        return np.full(len(poses), UP)

    checker.measure(watched)
    of_check = seen[0]
    seen.clear()
    checker.confirm(watched, reward.nearest_actions)
    assert len(seen[0]) == 2 * len(of_check) == 40
    assert not (seen[0][:, None] == of_check).all(axis=2).any()
