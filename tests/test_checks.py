import json

import numpy as np

from koopdqn.intent.reward import ASKED, REMEMBERED, RULE, TRUSTED
from koopdqn.rl.checks import Check, History


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
