"""The guard: adversarial policies are stopped before a limit or a rule is broken, taught paths are not stopped."""

import logging
from functools import cache

import numpy as np
import pytest
from helpers_shelf import held_out, reward_of, shelf, taught
from hypothesis import given, settings
from hypothesis import strategies as st

from koopdqn import pose
from koopdqn.app.api import load_config
from koopdqn.errors import WorkFailedError
from koopdqn.evaluation.baselines import Greedy
from koopdqn.evaluation.dynamics import play
from koopdqn.evaluation.evaluate import evaluate
from koopdqn.evaluation.schema import EvaluationSettings
from koopdqn.pose import Array
from koopdqn.programs.program import check_clear, make_program
from koopdqn.programs.timing import Motion
from koopdqn.safety import Guard, GuardSettings
from koopdqn.safety.guard import CAUSES, SPEED, TUBE
from koopdqn.tasks.actions import COUNT, nearest_actions
from koopdqn.tasks.rollout import RULE_BROKEN, STEP_LIMIT, STUCK, SUCCESS, Controller, Episode
from koopdqn.tasks.workcell import COLLISION

CONFIG = load_config()
SETTINGS = CONFIG.guard
STARTS = 4


def guard(*, tube: bool = True, **fields: object) -> Guard:
    known = taught()
    allowed = GuardSettings.model_validate({**dict(SETTINGS), **fields})
    return Guard(shelf(), allowed, known.trust if tube else None, known.model.start_frame)


def test_a_program_keeps_what_the_guard_keeps() -> None:
    joints, reason = shelf().reachability.follow(taught().trajectories[0])
    assert joints is not None, reason
    motion = Motion(0.02, joints, shelf().arm.forward(joints), np.arange(float(len(joints))))
    check_clear(guard(clearance_m=0.0005), motion)
    with pytest.raises(WorkFailedError, match=r"the arm must keep 24 mm from what stands around.* after .* s at \["):
        check_clear(guard(clearance_m=0.024), motion)


def constant(action: int) -> Controller:
    return lambda poses, starts: np.full(len(poses), action)


def randomly(seed: int) -> Controller:
    rng = np.random.default_rng(seed)
    return lambda poses, starts: rng.integers(0, COUNT, len(poses))


def toward(target: tuple[float, float, float]) -> Controller:
    """Always the action nearest to the way to a place."""

    def policy(poses: Array, starts: Array) -> np.ndarray:
        way = np.array(target) - poses[:, pose.POSITION]
        step = shelf().task.step_m * way / np.linalg.norm(way, axis=1, keepdims=True)
        return nearest_actions(poses, pose.make(poses[:, :3] + step, poses[:, 3:]), shelf().task)

    return policy


WALLS = {"floor": (0.5, -0.2, -0.5), "shelf": (0.3, 0.6, 0.3), "base": (0.0, 0.0, 0.3), "far": (2.0, -2.0, 0.5)}
ADVERSARIES = {
    **{f"action {action}": constant(action) for action in range(COUNT)},
    **{f"random {seed}": randomly(seed) for seed in range(2)},
    **{f"toward the {name}": toward(place) for name, place in WALLS.items()},
}


@cache
def rolled(name: str, tube: bool) -> tuple[Guard, list[Episode]]:
    keeper = guard(tube=tube)
    wall = name.startswith("toward")
    starts, joints = held_out(STARTS if wall else 2)
    return keeper, keeper.roll_out(ADVERSARIES[name], starts, joints, 600 if wall else 400)


def assert_kept(episode: Episode, settings: GuardSettings) -> None:
    """Check a path anew, by its joint angles alone, for everything that the guard promises."""
    cell = shelf()
    arm = cell.arm
    assert (episode.joints >= np.array(arm.joint_lower)).all()
    assert (episode.joints <= np.array(arm.joint_upper)).all()
    assert not any(cell.scene.contact(joints) for joints in episode.joints)
    assert not cell.task.rule_broken(episode.poses).any()
    if episode.steps:
        seconds = settings.stretch * arm.step_seconds
        assert (np.abs(np.diff(episode.joints, axis=0)) <= seconds * np.array(arm.velocity_limits) * (1 + 1e-9)).all()


@pytest.mark.parametrize("tube", [True, False])
@pytest.mark.parametrize("name", ADVERSARIES)
def test_an_adversarial_policy_is_stopped_before_anything_is_broken(name: str, tube: bool) -> None:
    keeper, episodes = rolled(name, tube)
    stopped = [episode for episode in episodes if episode.outcome in CAUSES]
    assert len(stopped) == len(keeper.refusals)
    for episode in episodes:
        assert_kept(episode, SETTINGS)
        # What neither reaches the goal nor is stopped has only spent its time.
        assert episode.outcome in (*CAUSES, SUCCESS, STUCK, STEP_LIMIT)
    if tube:
        assert all(episode.outcome != SUCCESS for episode in episodes)


def test_what_goes_to_a_wall_is_stopped_by_the_wall_or_the_tube() -> None:
    for name in WALLS:
        watched, alone = ({e.outcome for e in rolled(f"toward the {name}", tube)[1]} for tube in (True, False))
        assert watched <= {TUBE, COLLISION}, name
        assert alone <= {*CAUSES, STUCK, STEP_LIMIT}, name
    assert COLLISION in {e.outcome for e in rolled("toward the shelf", False)[1]}


STRANGE = {
    r"shape \(2,\), found \(\)": None,
    r"shape \(2,\), found \(1,\)": [8],
    "from 0 to 9, found -1": [8, -1],
    "from 0 to 9, found 10": [10, 8],
    "a whole number, found": [8.0, 2.5],
    r"shape \(2, 3\), found \(2, 5\)": np.zeros((2, 5)),
    "finite, found NaN": [[0.0, 0.0, np.nan]] * 2,
}


@pytest.mark.parametrize("words", STRANGE)
def test_what_a_policy_of_others_chooses_is_checked(words: str) -> None:
    starts, joints = held_out(2)
    with pytest.raises(ValueError, match=f"actions? must (be|have) {words}"):
        guard().roll_out(lambda poses, starts: STRANGE[words], starts, joints, 5)  # type: ignore[return-value,arg-type]


def test_a_policy_of_others_may_choose_by_a_list() -> None:
    starts, joints = held_out(2)
    keeper, eights = guard(tube=False), [8, 8]
    listed = keeper.roll_out(lambda poses, starts: eights, starts, joints, 5)  # type: ignore[arg-type,return-value]
    array = keeper.roll_out(constant(8), starts, joints, 5)
    assert [each.poses.tolist() for each in listed] == [each.poses.tolist() for each in array]


@cache
def episodes() -> list[Episode]:
    starts, joints = held_out(STARTS)
    return guard().roll_out(Greedy(taught().model, shelf().task), starts, joints, 700)


def test_a_taught_path_is_not_stopped() -> None:
    assert [episode.outcome for episode in episodes()] == [SUCCESS] * STARTS
    keeper = guard()
    assert [keeper.review(episode.poses, episode.joints) for episode in episodes()] == [None] * STARTS
    assert keeper.report().stopped == 0
    assert keeper.report().first is None


def test_a_turn_against_the_rule_is_refused_and_named(caplog: pytest.LogCaptureFixture) -> None:
    path, joints = episodes()[0].poses[:3].copy(), episodes()[0].joints[:3]
    tilt = pose.from_rotation_vector([0.0, np.radians(2.0), 0.0])
    path[2, 3:] = pose.multiply(path[2, 3:], tilt)
    keeper = guard()
    with caplog.at_level(logging.WARNING, logger="koopdqn.safety"):
        refusal = keeper.review(path, joints)
    assert refusal is not None
    assert (refusal.step, refusal.cause) == (1, RULE_BROKEN)
    assert shelf().task.rule in refusal.detail
    assert str(refusal) in caplog.text
    assert keeper.report().causes == {**dict.fromkeys(CAUSES, 0), RULE_BROKEN: 1}


def test_speed_limits_of_joints_and_flange() -> None:
    path, joints = episodes()[0].poses, episodes()[0].joints
    slow = guard(tool_speed_m_s=0.05).review(path, joints)
    assert slow is not None
    assert slow.cause == SPEED
    assert "0.05 m/s" in slow.detail
    # From far away the same step needs joints that are too fast.
    keeper = guard(tube=False, stretch=1.0, tool_speed_m_s=100.0)
    (motion,) = keeper.moves(path[40:41], path[:1], joints[:1], path[:1])
    assert (motion.joints, motion.reason) == (None, SPEED)
    assert "0.02 s" in motion.detail


def test_outside_the_tube_only_the_way_back_is_allowed() -> None:
    path, joints = episodes()[0].poses, episodes()[0].joints
    keeper = guard(tube_margin_m=0.0)
    out = path[:1].copy()
    out[:, 0] += 0.06
    angles = shelf().reachability.enter(out[0]).joints
    assert angles is not None
    farther, nearer = out.copy(), out.copy()
    farther[:, 0] += 0.002
    nearer[:, 0] -= 0.002
    begun = np.repeat(path[:1], 1, axis=0)
    (refused,) = keeper.moves(farther, out, angles[None], begun)
    (allowed,) = keeper.moves(nearer, out, angles[None], begun)
    assert (refused.reason, allowed.reason) == (TUBE, "")
    assert guard(tube_margin_m=None).moves(farther, out, angles[None], begun)[0].joints is not None
    assert joints is not None


def test_the_arm_keeps_its_distance_and_one_that_is_nearer_may_only_come_away() -> None:
    clearance = 0.01
    starts, joints = held_out(STARTS)
    scene = shelf().scene
    touching, keeping = guard(tube=False, clearance_m=0.0), guard(tube=False, clearance_m=clearance)
    plain = touching.roll_out(toward(WALLS["shelf"]), starts, joints, 600)
    kept = keeping.roll_out(toward(WALLS["shelf"]), starts, joints, 600)
    assert {episode.outcome for episode in kept} == {COLLISION}
    assert "must keep 10 mm from what stands around" in keeping.refusals[0].detail
    for near, far in zip(plain, kept, strict=True):
        assert far.steps < near.steps
        assert min(min(scene.rooms(row, clearance)) for row in far.joints) >= clearance
    # Along the path that came nearer, forward is refused and back is not.
    path = next(episode for episode in plain if episode.outcome == COLLISION)
    before, here = path.poses[-2:-1], path.poses[-1:]
    (on,) = keeping.moves(here, before, path.joints[-2:-1], path.poses[:1])
    (back,) = keeping.moves(before, here, path.joints[-1:], path.poses[:1])
    assert (on.reason, back.reason) == (COLLISION, "")


@settings(max_examples=10)
@given(rows=st.integers(5, 120), deceleration=st.floats(0.5, 20.0))
def test_a_stopped_path_brakes_within_what_was_allowed(rows: int, deceleration: float) -> None:
    keeper = guard(deceleration_rad_s2=deceleration)
    joints = episodes()[0].joints[:rows]
    durations = keeper.durations(joints)
    assert (durations >= shelf().reachability.durations(joints)).all()
    turn = np.abs(np.diff(joints, axis=0)).max(axis=1)
    left = np.cumsum(turn[::-1])[::-1]
    assert (turn / durations <= np.sqrt(2.0 * deceleration * left) + 1e-9).all()


def test_the_arm_stands_where_it_was_stopped() -> None:
    joints = episodes()[0].joints[:60]
    made = play(shelf(), joints, guard().durations(joints, 2.0))
    assert made.tracking_error_mm.max() < 1.0
    assert made.sag_mm < 0.01
    assert made.contact_steps == 0


def test_eval_executes_a_stopped_path_only_up_to_there() -> None:
    known = taught()
    given = EvaluationSettings.model_validate(
        {**dict(CONFIG.eval), "episodes": 2, "dynamics_episodes": 2, "baselines": False}
    )
    policy = Greedy(known.model, shelf().task)

    def dynamics(allowed: GuardSettings | None) -> dict[str, object]:
        report = evaluate(shelf(), policy, reward_of(known), known.trajectories, given, 700, guard=allowed).report
        assert report["success_rate"] == 1.0
        return dict(report["dynamics"])

    free, watched = dynamics(None), dynamics(SETTINGS)
    assert free["guard"] is None
    assert watched["guard"] == {"stopped": 0, "causes": dict.fromkeys(CAUSES, 0), "first": None}
    assert {**free, "guard": None} == {**watched, "guard": None}
    stopped = dynamics(SETTINGS.model_copy(update={"tool_speed_m_s": 0.05}))
    assert isinstance(stopped["guard"], dict)
    assert stopped["guard"]["causes"][SPEED] == 2
    assert stopped["episodes"] == 0
    # Executed at half speed a step of 0.105 m/s takes twice as long.
    assert dynamics(SETTINGS.model_copy(update={"tool_speed_m_s": 0.1})) == watched


def test_export_refuses_a_path_that_the_guard_stops() -> None:
    policy = Greedy(taught().model, shelf().task)
    assert make_program(shelf(), policy, CONFIG.program, 900, guard=guard()).task == "shelf"
    with pytest.raises(WorkFailedError, match=r"found collision after \d+ steps .* must keep 24 mm"):
        make_program(shelf(), policy, CONFIG.program, 900, guard=guard(clearance_m=0.024))


def test_a_program_is_as_slow_as_the_guard_asks() -> None:
    known = taught()
    allowed = SETTINGS.model_copy(update={"tool_speed_m_s": 0.05})
    keeper = Guard(shelf(), allowed, known.trust, known.model.start_frame, time_scale=None)
    program = make_program(shelf(), Greedy(known.model, shelf().task), CONFIG.program, 900, guard=keeper)
    tool = np.linalg.norm(np.diff(program.motion.poses[:, :3], axis=0), axis=1) / program.motion.period
    assert 0.04 < tool.max() <= 0.05
