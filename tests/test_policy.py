from pathlib import Path

import numpy as np
import pytest
from parts import Parts, with_fields
from safetensors.numpy import load_file, save_file

from koopdqn.artifact import described
from koopdqn.dqn.learner import Learner
from koopdqn.dqn.observation import observe
from koopdqn.dqn.policy import Policy, read_policy, write_policy
from koopdqn.errors import BadInputError


@pytest.fixture
def path(tmp_path: Path, parts: Parts) -> Path:
    written = tmp_path / "policy.safetensors"
    write_policy(written, learner(parts).policy_arrays(), parts.agent.network, about(parts))
    return written


def learner(parts: Parts) -> Learner:
    return Learner(5, parts.agent, np.random.default_rng(0))


def about(parts: Parts) -> dict[str, object]:
    return {"task": described(parts.task), "seed": 0, "agent": described(parts.agent)}


def test_a_policy_comes_back_with_what_it_says_of_itself(path: Path, parts: Parts) -> None:
    policy, said = read_policy(path, parts.task)
    poses = parts.task.draw_starts(np.random.default_rng(1), 50)
    original = Policy(learner(parts).online, parts.task)
    np.testing.assert_array_equal(policy.values(poses), original.values(poses))
    np.testing.assert_array_equal(policy(poses), original(poses))
    assert said["seed"] == 0
    assert said["agent"] == described(parts.agent)


def test_it_is_the_argmax_of_the_values_on_the_observation_alone(parts: Parts) -> None:
    network = learner(parts).online
    policy = Policy(network, parts.task)
    poses = parts.task.draw_starts(np.random.default_rng(1), 50)
    values = network.values(observe(poses, parts.task))
    np.testing.assert_array_equal(policy(poses), values.argmax(axis=1))
    assert policy(poses).shape == (50,)
    assert len(set(policy(poses[:1]).tolist())) == 1


def test_the_same_policy_gives_the_same_bytes(path: Path, parts: Parts) -> None:
    other = path.with_name("again.safetensors")
    write_policy(other, learner(parts).policy_arrays(), parts.agent.network, about(parts))
    assert other.read_bytes() == path.read_bytes()


def test_the_policy_of_another_task_is_refused_with_what_differs(path: Path, parts: Parts) -> None:
    for changes in ({"name": "other"}, {"goal_tolerance_m": 0.004, "lip_m": 0.0}):
        with pytest.raises(BadInputError, match=rf"\(differing: {', '.join(sorted(changes))}\)"):
            read_policy(path, with_fields(parts.task, **changes))


def test_arrays_edited_by_hand_are_refused(path: Path, parts: Parts) -> None:
    from safetensors import safe_open

    with safe_open(path, framework="numpy") as file:
        metadata = file.metadata()
    arrays = load_file(path)
    name = next(iter(arrays))
    save_file(arrays | {name: arrays[name] + 1}, path, metadata=metadata)
    with pytest.raises(BadInputError, match="changed by hand"):
        read_policy(path, parts.task)


def test_arrays_that_do_not_fit_the_settings_are_refused(path: Path, parts: Parts) -> None:
    narrower = parts.agent.network.model_copy(update={"hidden": (3,)})
    write_policy(path, learner(parts).policy_arrays(), narrower, about(parts))
    with pytest.raises(BadInputError, match="must hold the arrays of its own settings") as caught:
        read_policy(path, parts.task)
    assert "\n" not in str(caught.value)


def test_a_policy_that_is_missing_is_refused(tmp_path: Path, parts: Parts) -> None:
    with pytest.raises(BadInputError, match=r"policy file .* must exist"):
        read_policy(tmp_path / "none.safetensors", parts.task)
