"""Random scenes with an obstacle on the demonstrated path, and how methods do in them; the table of docs/obstacles.md.

    scripts/obstacle_scenes.py RUN SCENES SEED FILE

RUN is a run trained without obstacles. In every third scene the arm's body alone would be hit. A line of JSON a scene
is added to FILE, and scenes that it holds are not measured again.
"""

import json
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from imitation.primitives import dmp
from scipy.spatial import KDTree

from koopdqn import pose
from koopdqn.app.commands import pipeline
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.commands.demonstrated import with_task
from koopdqn.app.commands.trained import as_trained, step_limit_of
from koopdqn.app.exit_status import guard
from koopdqn.app.hydra.compose import composed
from koopdqn.app.hydra.overrides import prepare
from koopdqn.errors import BadInputError
from koopdqn.evaluation.baselines import Greedy, replay_path, straight_path
from koopdqn.intent.detour import around_obstacles
from koopdqn.intent.fit import agent_steps
from koopdqn.intent.reward import IntentReward
from koopdqn.intent.storage import read_intent
from koopdqn.paths import mean_poses, to_count
from koopdqn.pose import Array
from koopdqn.rl.policy import Policy, around, read_policy
from koopdqn.robot.scene import Scene
from koopdqn.run_folder import INTENT, POLICY
from koopdqn.tasks.obstacles import Obstacle
from koopdqn.tasks.rollout import SUCCESS, Controller, Episode, follow, roll_out
from koopdqn.tasks.workcell import Workcell, open_workcell

_CLEARANCE_M: Final = 0.01
_STARTS: Final = 4
# Where an obstacle may block the path, as shares of it, and what it leaves around starts and goal [m].
_FIRST, _LAST, _FREE_M = 0.12, 0.80, 0.02
_BEHIND_M: Final = 0.06
_DRAWS: Final = 3000
# The search for any way at all: its grid [m], how far from the path it looks [m], through how many of its attitudes,
# how far a joint may move from place to place [rad], and by how much it moves between two looks [rad].
_CELL_M, _ASIDE_M, _ATTITUDES = 0.015, 0.2, 24
_SWEPT_RAD, _SEEN_RAD = 0.6, 0.03


@dataclass(frozen=True)
class Learned:
    """A trained run and what is measured with it.

    Attributes:
        workcell: without obstacles.
        reward: with the fitted intent.
        policy: that was learned.
        shown: demonstrated poses (N, 7).
        limit: steps of an episode.
        path: (T, 7) the intent's own, from the nominal start.
        joints: (T, 6) [rad] along it.
        starts: joints (S, 6) [rad] at starts that scenes leave free.
    """

    workcell: Workcell
    reward: IntentReward
    policy: Policy
    shown: list[Array]
    limit: int
    path: Array
    joints: Array
    starts: Array

    @classmethod
    def read(cls, run: Path) -> "Learned":
        """Return a run of ``koopdqn train``."""
        config = Configuration.load(composed(prepare("eval", [f"run={run}", "out=unused"]).overrides))
        config = as_trained(with_task(config, run, keep=False), run)
        policy, _ = read_policy(run / POLICY, config.task)
        intent = read_intent(run / INTENT, config.task)
        workcell = pipeline.open_scene(config)
        shown = agent_steps(pipeline.demonstrations_of(config, run), config.task)
        reward = pipeline.reward_of(config, workcell, intent, shown)
        limit = step_limit_of(run)
        path = intent.model.intended_paths(config.task.nominal_start[None], limit, config.task.step_m)[:, 0]
        joints, _ = workcell.reachability.follow_as_far(path)
        starts = workcell.reachability.draw_starts(config.task, np.random.default_rng(0), 8)[1]
        return cls(workcell, reward, policy, shown, limit, path, np.array(joints), starts)


def is_tool(scene: Scene, geom: int) -> bool:
    """Return whether a geom is of the tool or of what it holds; of an arm without a tool, of its last link."""
    model, body = scene.model, scene.model.geom_bodyid[geom]
    if any("/tool" in model.body(each).name for each in model.geom_bodyid):
        return "/tool" in model.body(body).name
    return bool(model.body_weldid[body] == max(model.jnt_bodyid))


def near_obstacles(scene: Scene, joints: Array) -> tuple[list[int], set[str]]:
    """Return at which of joints (T, 6) something is nearer to an obstacle than its clearance, and what: tool or arm."""
    rows, things = [], set()
    for row, here in enumerate(joints):
        scene.place(here)
        mujoco.mj_collision(scene.model, scene.data)
        for contact in scene.data.contact if scene.data.ncon else ():
            first, second = map(int, contact.geom)
            names = [scene.model.geom(geom).name.startswith("obstacle_") for geom in (first, second)]
            if any(names) and contact.dist < _CLEARANCE_M:
                rows.append(row)
                things.add("tool" if is_tool(scene, second if names[0] else first) else "arm")
    return sorted(set(rows)), things


def drawn(rng: np.random.Generator, learned: Learned, *, body: bool) -> tuple[Obstacle, int, int] | None:
    """Return an obstacle and the first and last step of the path that it blocks; None if no draw will do."""
    cell, count = learned.workcell, len(learned.joints)
    model, data = cell.scene.model, cell.scene.data
    moving = [i for i in range(model.ngeom) if model.body_weldid[model.geom_bodyid[i]] and model.geom_contype[i]]
    parts = [i for i in moving if is_tool(cell.scene, i) != body]
    for _ in range(_DRAWS):
        step = int(rng.uniform(0.25, 0.75) * count)
        cell.scene.place(learned.joints[step])
        center = learned.path[step, pose.POSITION].copy()
        if parts:
            part = int(rng.choice(parts))
            way = rng.normal(size=3)
            center = data.geom_xpos[part] + rng.uniform(0, model.geom_rbound[part]) * way / np.linalg.norm(way)
        obstacle = _obstacle(rng, center + rng.normal(scale=0.01, size=3))
        try:
            scene = open_workcell(cell.task.model_copy(update={"obstacles": (obstacle,)}), cell.arm).scene
        except BadInputError:
            continue
        rows, things = near_obstacles(scene, learned.joints)
        if not rows or rows[0] < _FIRST * count or rows[-1] > _LAST * count or ("tool" in things) == body:
            continue
        if min(scene.rooms(each, 0.03)[0] for each in (*learned.starts, learned.joints[-1])) >= _FREE_M:
            return obstacle, rows[0], rows[-1]
    return None


def _obstacle(rng: np.random.Generator, center: Array) -> Obstacle:
    quaternion = pose.normalized(rng.normal(size=4))
    a, b, c = (float(each) for each in rng.uniform(0.02, 0.045, 3))
    shape = ("box", "sphere", "cylinder")[int(rng.integers(3))]
    sizes: dict[str, dict[str, Any]] = {
        "box": {"size_m": (2 * a, 2 * b, 2 * c)},
        "sphere": {"radius_m": a},
        "cylinder": {"radius_m": a, "height_m": 2 * b},
    }
    held = {"center_m": tuple(center.tolist()), "quaternion": tuple(quaternion.tolist()), **sizes[shape]}
    return Obstacle.model_validate({"name": "thing", "shape": shape, "clearance_m": _CLEARANCE_M, **held})


def measured(learned: Learned, obstacle: Obstacle, last: int) -> dict[str, Any]:
    """Return the successes of every method in a scene, of :data:`_STARTS` starts each, and how far behind it they are.

    ``behind_mm`` is the distance of each successful path from the intent's own, 60 mm after the last blocked step.
    """
    plain = learned.workcell
    task = plain.task.model_copy(update={"obstacles": (obstacle,)})
    cell = open_workcell(task, plain.arm)
    starts, joints, _ = cell.reachability.draw_starts(task, np.random.default_rng(1), _STARTS)

    def led(controller: Controller) -> list[Episode]:
        return roll_out(controller, task, cell.reachability, starts, joints, learned.limit, cut_circles=True)

    def followed(path: Callable[[Array], Array]) -> list[Episode]:
        return follow([path(start) for start in starts], task, cell.reachability, joints)

    frame = learned.reward.model.start_frame
    placed = frame.each(learned.shown)
    mean = mean_poses(placed, max(len(rows) for rows in placed))

    primitive = dmp(learned.shown, np.array(obstacle.center_m))

    def dmp_path(start: Array) -> Array:
        path = primitive(start, task.goal)
        length = np.linalg.norm(np.diff(path[:, pose.POSITION], axis=0), axis=1).sum()
        return to_count(path, 2 + int(length / task.step_m))

    def mean_path(start: Array) -> Array:
        path = frame.from_frame(mean, start[None], mean)
        return np.concatenate([straight_path(start, path[0], task), path[1:]])

    made = {
        "greedy": led(Greedy(learned.reward.model, task, continuous=learned.reward.continuous)),
        "replay": followed(lambda start: replay_path(start, learned.shown, task)),
        "mean": followed(mean_path),
        "dmp": followed(dmp_path),
        "unaware": led(learned.policy),
    }
    row: dict[str, Any] = {"way": True, "behind_mm": []}
    try:
        reward = around_obstacles(cell, learned.reward, learned.shown)
    except BadInputError:
        row |= {"way": False, "exists": way_exists(learned, cell)}
    else:
        made["policy"] = led(around(learned.policy, reward.model))
        made["modulated"] = led(Greedy(reward.model, task, continuous=reward.continuous))
        row["behind_mm"] = behind(learned, made["policy"], last, starts)
        row["floor_mm"] = behind(
            learned,
            roll_out(learned.policy, plain.task, plain.reachability, starts, joints, learned.limit),
            last,
            starts,
        )
    lost = [each for each in made.get("policy", []) if each.outcome != SUCCESS]
    row["failures"] = sorted({f"{each.outcome} {each.detail}" for each in lost})
    return row | {name: sum(each.outcome == SUCCESS for each in episodes) for name, episodes in made.items()}


def way_exists(learned: Learned, cell: Workcell) -> bool:
    """Return whether any way leads the arm from the nominal start to the goal, as far as a grid of 15 mm can tell.

    The tool may be anywhere within 0.2 m of the path, in any of the path's attitudes, which may change from place to
    place; from one to the next the joints move evenly, and the whole arm stays clear. It is no part of the method, and
    allows more than any method may do.
    """
    path, arm, scene = learned.path, cell.arm, cell.scene
    turned = np.append(0.0, np.cumsum(pose.rotation_distance(path[1:], path[:-1])))
    held = cell.task.orientation == "held"
    shares = np.ones(1) if held else np.linspace(0.0, 1.0, _ATTITUDES)
    attitudes = path[np.searchsorted(turned, shares * turned[-1]), pose.QUATERNION]
    low = path[:, pose.POSITION].min(axis=0) - _ASIDE_M
    high = path[:, pose.POSITION].max(axis=0) + _ASIDE_M
    shape = np.array([*(np.ceil((high - low) / _CELL_M).astype(int) + 1), len(attitudes)])

    def node(place: Array, attitude: int) -> tuple[int, ...]:
        return (*np.round((place[pose.POSITION] - low) / _CELL_M).astype(int).tolist(), attitude)

    def clear(before: Array, after: Array) -> bool:
        far = float(np.abs(after - before).max())
        if np.isnan(far) or far > _SWEPT_RAD:
            return False
        between = np.linspace(1.0, 0.0, 2 + int(far / _SEEN_RAD))[:-1, None]
        return all(min(scene.rooms(each, 0.0)) >= 0.0 for each in before + between * (after - before))

    start, goal = node(path[0], 0), node(path[-1], len(attitudes) - 1)
    postures = {start: learned.joints[0]}
    steps = np.concatenate([np.eye(4, dtype=int), -np.eye(4, dtype=int)])
    frontier = [start]
    while frontier and goal not in postures:
        beside: dict[tuple[int, ...], tuple[int, ...]] = {}
        for here in frontier:
            for there in np.array(here) + steps:
                if (there >= 0).all() and (there < shape).all() and tuple(there.tolist()) not in postures:
                    beside.setdefault(tuple(there.tolist()), here)
        nodes = np.array(list(beside)).reshape(-1, 4)
        before = np.array([postures[here] for here in beside.values()]).reshape(len(nodes), -1)
        found = arm.inverse_batch(pose.make(low + nodes[:, :3] * _CELL_M, attitudes[nodes[:, 3]]), before)
        reached = {there: after for there, one, after in zip(beside, before, found, strict=True) if clear(one, after)}
        postures |= reached
        frontier = list(reached)
    return goal in postures


def behind(learned: Learned, episodes: list[Episode], last: int, starts: Array) -> list[float]:
    """Return the distances [mm] of successful paths from the intent's, 60 mm after its step ``last``."""
    task, model = learned.workcell.task, learned.reward.model
    own = model.intended_paths(starts, learned.limit, task.step_m)
    place = min(len(learned.path) - 1, last + round(_BEHIND_M / task.step_m))
    found = []
    for index, episode in enumerate(episodes):
        if episode.outcome == SUCCESS:
            local = model.start_frame.to_frame(episode.poses, starts[index][None])
            reached = KDTree(learned.path[:, :3]).query(local[:, :3])[1] >= place
            here = episode.poses[reached][:1, :3]
            found.append(float(KDTree(own[:, index, :3]).query(here)[0][0]) * 1e3)
    return found


def main(run: str, scenes: str, seed: str, file: str) -> int:
    """Measure scenes and add a line each to a file.

    Raises:
        BadInputError: the file holds scenes of another run or seed, or see :meth:`Learned.read`.
    """
    warnings.simplefilter("ignore", RuntimeWarning)
    learned, results = Learned.read(Path(run)), Path(file)
    held = results.read_text().splitlines() if results.is_file() else []
    made_with = {"run": Path(run).name, "seed": int(seed)}
    for line in held:
        for key, value in made_with.items():
            if (found := json.loads(line).get(key, value)) != value:
                raise BadInputError(f"{file}: must hold scenes of {key} {value}, found {found}")
    for index in range(len(held), int(scenes)):
        body = index % 3 == 2
        scene = drawn(np.random.default_rng([int(seed), index]), learned, body=body)
        row: dict[str, Any] = {"scene": index, **made_with, "body": body, "drawn": scene is not None}
        if scene is not None:
            obstacle, first, last = scene
            row |= {"shape": obstacle.shape, "blocked": [first, last]} | measured(learned, obstacle, last)
        with results.open("a") as lines:
            lines.write(json.dumps(row) + "\n")
        print(json.dumps(row), flush=True)
    return 0


if __name__ == "__main__":
    if len(sys.argv) != len(("script", "RUN", "SCENES", "SEED", "FILE")):
        sys.exit(__doc__)
    sys.exit(guard(lambda: main(*sys.argv[1:]), debug=False))
