"""Learned paths in MuJoCo's dynamics, under nominal and perturbed conditions, and under the guard: `make physics`."""

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from docs import rows_table
from koopdqn.app.api import load_config
from koopdqn.app.commands import pipeline
from koopdqn.app.commands.demonstrated import with_task
from koopdqn.app.commands.trained import step_limit_of
from koopdqn.app.hydra.record import check_record, read_record
from koopdqn.evaluation.dynamics import play
from koopdqn.evaluation.evaluate import drawn_starts
from koopdqn.intent.storage import read_intent
from koopdqn.pose import Array
from koopdqn.rl.policy import read_policy
from koopdqn.robot.scene import Scene
from koopdqn.run_folder import INTENT, POLICY
from koopdqn.safety import Guard
from koopdqn.tasks.actions import COUNT
from koopdqn.tasks.rollout import SUCCESS
from koopdqn.tasks.workcell import Workcell

TIME_SCALE: Final = 2.0
"""As in `koopdqn eval`."""
SEED: Final = 5000
"""Of the starts, the noise and the adversaries."""
CYCLE: Final = 4
"""Physics steps in a controller's cycle, for which one command holds: 8 ms."""
TRACKING_MM, TRACKING_DEG = 2.0, 0.5
"""What an executed path must keep to its commands."""


@dataclass(frozen=True)
class Condition:
    """What differs from the model that the path was planned with.

    Attributes:
        payload: mass of the last link, tool and payload, as a share of the model's.
        friction_nm: dry friction in every joint [Nm].
        noise_rad: standard deviation of the joint angles that are commanded, as encoders would disturb them.
        dropped: share of commands that are lost; the last one holds on.
    """

    payload: float = 1.0
    friction_nm: float = 0.0
    noise_rad: float = 0.0
    dropped: float = 0.0

    def scene(self, scene: Scene) -> Scene:
        """Return the scene under this condition."""
        changed = copy.copy(scene)
        changed.model = copy.copy(scene.model)
        wrist = changed.model.jnt_bodyid[changed.model.dof_jntid[changed.velocity_index[-1]]]
        for body in range(changed.model.nbody):
            if _hangs_on(changed.model, body, int(wrist)):
                changed.model.body_mass[body] *= self.payload
                changed.model.body_inertia[body] *= self.payload
        changed.model.dof_frictionloss[changed.velocity_index] = self.friction_nm
        mujoco.mj_setConst(changed.model, mujoco.MjData(changed.model))
        return changed

    def commanded(self, rng: np.random.Generator) -> Callable[[Array], Array]:
        """Return what becomes of the commands (S, 6) [rad] of a path."""

        def change(commands: Array) -> Array:
            noisy = commands + rng.normal(0.0, 1.0, commands.shape) * self.noise_rad
            lost = np.repeat(rng.random(-(-len(commands) // CYCLE)) < self.dropped, CYCLE)[: len(commands)]
            heard = np.where(lost, 0, np.arange(len(commands)))
            return np.asarray(noisy[np.maximum.accumulate(heard)])

        return change


CONDITIONS: Final = {
    "nominal": Condition(),
    "payload −30 %": Condition(payload=0.7),
    "payload +30 %": Condition(payload=1.3),
    "joint friction 2 Nm": Condition(friction_nm=2.0),
    "sensor noise 0.0005 rad": Condition(noise_rad=0.0005),
    "one command in 50 dropped": Condition(dropped=0.02),
    "all of them, payload +30 %": Condition(1.3, 2.0, 0.0005, 0.02),
}


def _hangs_on(model: Any, body: int, wrist: int) -> bool:
    """Return whether a body hangs on the wrist without a joint of its own between."""
    while body and body != wrist:
        body = int(model.body_parentid[body])
    return body == wrist and wrist != 0


def measured(runs: list[Path], paths: int) -> dict[str, Any]:
    """Return, by task, what became of the paths that runs learned."""
    found = {}
    for run in runs:
        config = load_config(*check_record(read_record(run, "a training run"), run, (), ()))
        config = with_task(config, run, keep=False)
        workcell = pipeline.open_scene(config)
        policy, _ = read_policy(run / POLICY, config.task)
        intent = read_intent(run / INTENT, config.task)
        limit = step_limit_of(run)
        chosen = config.eval.model_copy(update={"episodes": paths, "seed": SEED})
        drawn = drawn_starts(workcell, chosen)
        starts, joints = drawn.starts, drawn.joints
        guard = Guard(workcell, config.guard, intent.trust, intent.model.start_frame)
        episodes = guard.roll_out(policy, starts, joints, limit)
        learned = [episode for episode in episodes if episode.outcome == SUCCESS]
        rows = {name: _played(workcell, condition, learned) for name, condition in CONDITIONS.items()}
        found[config.task.name] = {
            "paths": paths,
            "learned": len(learned),
            "guard_stopped_learned": len(guard.refusals),
            "causes": {cause: count for cause, count in guard.report().causes.items() if count},
            "adversaries": _adversaries(workcell, guard, starts, joints, limit),
            "conditions": rows,
        }
    return found


def _played(workcell: Workcell, condition: Condition, episodes: list[Any]) -> dict[str, float | int]:
    cell = replace(workcell, scene=condition.scene(workcell.scene))
    rng = np.random.default_rng(SEED)
    mm, deg, contacts, off, over = [], [], 0, 0, 0
    for episode in episodes:
        durations = TIME_SCALE * workcell.reachability.durations(episode.joints)
        made = play(cell, episode.joints, durations, condition.commanded(rng))
        mm.append(float(made.tracking_error_mm.max()))
        deg.append(float(made.rotation_error_deg.max()))
        contacts += made.contact_steps > 0
        off += mm[-1] > TRACKING_MM or deg[-1] > TRACKING_DEG
        over += made.torque_ratio > 1.0 or made.speed_ratio > 1.0
    worst = {"tracking_mm": max(mm, default=0.0), "tracking_deg": max(deg, default=0.0)}
    return {"played": len(episodes), **worst, "off": off, "contacts": contacts, "limits": over}


def _adversaries(workcell: Workcell, guard: Guard, starts: Array, joints: Array, limit: int) -> dict[str, int]:
    """Return how many adversarial episodes there were and how many broke anything before they were stopped."""
    rng = np.random.default_rng(SEED)
    keeper = Guard(workcell, guard.settings)
    constant = rng.integers(0, COUNT, len(starts))
    kinds: list[Callable[[Array, Array], np.ndarray]] = [
        lambda poses, begun: rng.integers(0, COUNT, len(poses)),
        lambda poses, begun: np.array([constant[int(np.abs(starts - each).sum(axis=1).argmin())] for each in begun]),
    ]
    broken = 0
    for kind in kinds:
        for episode in keeper.roll_out(kind, starts, joints, limit):
            touched = any(workcell.scene.contact(row) for row in episode.joints)
            broken += bool(touched or workcell.task.rule_broken(episode.poses).any())
    return {"episodes": len(kinds) * len(starts), "broken": broken, "stopped": len(keeper.refusals)}


def table(known: dict[str, Any]) -> str:
    """Return the table of what was measured."""
    heads = ("task", "condition", "paths", "worst [mm]", "worst [°]", "over 2 mm or 0.5°", "contacts", "over a limit")
    rows = []
    for task, found in known.items():
        for name, row in sorted(found["conditions"].items(), key=lambda item: list(CONDITIONS).index(item[0])):
            worst = f"{row['tracking_mm']:.2f}", f"{row['tracking_deg']:.2f}"
            rows.append(
                (task, name, str(row["played"]), *worst, *(str(row[key]) for key in ("off", "contacts", "limits")))
            )
        against = found["adversaries"]
        said = (
            f"guard: stopped {found['guard_stopped_learned']} of {found['paths']} learned paths"
            f" ({', '.join(found['causes']) or 'no cause'}); of {against['episodes']} adversarial episodes"
            f" {against['stopped']} were stopped and {against['broken']} broke a rule or touched"
        )
        rows.append((task, said, *[""] * 6))
    return rows_table(heads, rows)
