import re
from pathlib import Path

import numpy as np
import pytest
from parts import Parts, with_fields
from safetensors.numpy import load_file, save_file

from koopdqn.artifact import described
from koopdqn.errors import BadInputError
from koopdqn.pose import Array
from koopdqn.rl.dqn import Learner
from koopdqn.rl.network import observe
from koopdqn.rl.policy import Policy, read_policy, write_policy
from koopdqn.tasks.start_frame import STILL, StartFrame


@pytest.fixture
def path(tmp_path: Path, parts: Parts) -> Path:
    written = tmp_path / "policy.safetensors"
    write_policy(written, learner(parts).policy_arrays(), parts.agent.network, STILL, about(parts))
    return written


def learner(parts: Parts) -> Learner:
    return Learner(5, parts.agent, np.random.default_rng(0))


def about(parts: Parts) -> dict[str, object]:
    return {"task": described(parts.task), "seed": 0, "agent": described(parts.agent)}


def test_a_policy_comes_back_with_what_it_says_of_itself(path: Path, parts: Parts) -> None:
    policy, said = read_policy(path, parts.task)
    poses = parts.task.draw_starts(np.random.default_rng(1), 50)
    original = Policy(learner(parts).online, parts.task)
    np.testing.assert_array_equal(policy.values(poses, poses), original.values(poses, poses))
    np.testing.assert_array_equal(policy(poses, poses), original(poses, poses))
    assert said["seed"] == 0
    assert said["agent"] == described(parts.agent)
    assert not policy.frame.follows


def test_strange_poses_are_refused(path: Path, parts: Parts) -> None:
    policy, _ = read_policy(path, parts.task)
    pose = parts.task.nominal_start
    with pytest.raises(BadInputError, match=r"poses must have shape \(N, 7\), found \(7,\)"):
        policy(pose, pose[None])
    with pytest.raises(BadInputError, match="starts must be finite, found NaN"):
        policy(pose[None], np.nan * pose[None])
    for odd in ([[1.0], [1.0, 2.0]], [["a"] * 7]):
        with pytest.raises(BadInputError, match=r"poses must be numbers of shape \(N, 7\), found \[\["):
            policy(odd, pose[None])  # type: ignore[arg-type]


def test_poses_may_be_lists(path: Path, parts: Parts) -> None:
    policy, _ = read_policy(path, parts.task)
    poses = parts.task.draw_starts(np.random.default_rng(1), 5)
    found = policy(poses.tolist(), poses.tolist())
    np.testing.assert_array_equal(found, policy(poses, poses))


def following(parts: Parts) -> StartFrame:
    return StartFrame(parts.task.nominal_start[:3], parts.task.goal[:3], follows=True)


def test_a_policy_comes_back_with_what_its_frame_learned_of_starts(tmp_path: Path, parts: Parts) -> None:
    poses, starts = on_the_way(parts)
    share = np.linspace(0.0, 1.0, 80)[:, None]
    shown = []
    for start in starts[:6]:
        rows = parts.task.goal + (1.0 - share) * (start - parts.task.goal)
        rows[:, 2] += np.sin(np.pi * share[:, 0]) * (start[0] - parts.task.nominal_start[0])
        shown.append(rows)
    frame = StartFrame.following(shown, parts.task.nominal_start, parts.task.goal)
    assert frame.regression is not None
    written = tmp_path / "policy.safetensors"
    write_policy(written, learner(parts).policy_arrays(), parts.agent.network, frame, about(parts))
    policy, _ = read_policy(written, parts.task)
    original = Policy(learner(parts).online, parts.task, frame)
    np.testing.assert_array_equal(policy.values(poses, starts), original.values(poses, starts))
    plain = Policy(learner(parts).online, parts.task, following(parts))
    assert (policy.values(poses, starts) != plain.values(poses, starts)).any()


def on_the_way(parts: Parts) -> tuple[Array, Array]:
    """Poses between starts and the goal, and the starts."""
    starts = parts.task.draw_starts(np.random.default_rng(1), 50)
    poses = starts.copy()
    poses[:, :3] += np.random.default_rng(2).uniform(size=(50, 1)) * (parts.task.goal[:3] - starts[:, :3])
    return poses, starts


def test_a_policy_that_follows_its_start_comes_back_with_its_frame(tmp_path: Path, parts: Parts) -> None:
    frame, written = following(parts), tmp_path / "policy.safetensors"
    write_policy(written, learner(parts).policy_arrays(), parts.agent.network, frame, about(parts))
    policy, _ = read_policy(written, parts.task)
    assert policy.frame.follows
    np.testing.assert_array_equal(policy.frame.start, frame.start)
    np.testing.assert_array_equal(policy.frame.goal, frame.goal)
    poses, starts = on_the_way(parts)
    original = Policy(learner(parts).online, parts.task, frame)
    np.testing.assert_array_equal(policy.values(poses, starts), original.values(poses, starts))
    np.testing.assert_array_equal(policy(poses, starts), original(poses, starts))


def test_a_policy_that_follows_its_start_observes_poses_as_from_the_nominal_one(parts: Parts) -> None:
    network, frame = learner(parts).online, following(parts)
    poses, starts = on_the_way(parts)
    values = Policy(network, parts.task, frame).values(poses, starts)
    np.testing.assert_array_equal(values, network.values(observe(frame.to_frame(poses, starts), parts.task)))
    assert not np.array_equal(values, Policy(network, parts.task).values(poses, starts))


def test_it_is_the_argmax_of_the_values_on_the_observation_alone(parts: Parts) -> None:
    network = learner(parts).online
    policy = Policy(network, parts.task)
    poses = parts.task.draw_starts(np.random.default_rng(1), 50)
    values = network.values(observe(poses, parts.task))
    np.testing.assert_array_equal(policy(poses, poses), values.argmax(axis=1))
    assert policy(poses, poses).shape == (50,)
    assert policy(poses[:1], poses[:1]) == policy(poses[:1], poses[7:8])


def test_the_same_policy_gives_the_same_bytes(path: Path, parts: Parts) -> None:
    other = path.with_name("again.safetensors")
    write_policy(other, learner(parts).policy_arrays(), parts.agent.network, STILL, about(parts))
    assert other.read_bytes() == path.read_bytes()


def test_the_policy_of_another_task_is_refused_with_what_differs(path: Path, parts: Parts) -> None:
    changes = {"goal_tolerance_m": 0.004, "lip_m": 0.0}
    both = [f"{key}, {getattr(parts.task, key)!r} there and {changes[key]!r} here" for key in sorted(changes)]
    with pytest.raises(BadInputError, match=re.escape(f"(differing: {', '.join(both)})")):
        read_policy(path, with_fields(parts.task, **changes))
    # Of a task of another name nearly everything differs.
    with pytest.raises(BadInputError, match=f"must be of task other, found task {parts.task.name}$"):
        read_policy(path, with_fields(parts.task, name="other"))


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
    write_policy(path, learner(parts).policy_arrays(), narrower, STILL, about(parts))
    with pytest.raises(BadInputError, match="must hold the arrays of its own settings") as caught:
        read_policy(path, parts.task)
    assert "\n" not in str(caught.value)


def test_a_policy_that_is_missing_is_refused(tmp_path: Path, parts: Parts) -> None:
    with pytest.raises(BadInputError, match=r"policy file .* must exist"):
        read_policy(tmp_path / "none.safetensors", parts.task)
