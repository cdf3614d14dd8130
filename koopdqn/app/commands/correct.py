"""``koopdqn correct``: lead a stretch of a learned path through waypoints, given or shown by keys; the rest stays."""

import json
import shlex
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic

import numpy as np

from koopdqn import console
from koopdqn.app.commands import pipeline
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.commands.trained import differs_from_trained, step_limit_of
from koopdqn.app.hydra.application import CommandResult, own_options, program
from koopdqn.app.recording.correcting import correct_by_keys
from koopdqn.app.recording.showing import Showing
from koopdqn.errors import BadInputError
from koopdqn.evaluation.correction import CorrectionFile, Followed, along, in_frame, played
from koopdqn.files import write_json
from koopdqn.intent.bend import Bend
from koopdqn.oracles.terminal.device import require_terminal
from koopdqn.pose import Array
from koopdqn.rl.policy import Policy, PolicyAround, read_policy, write_corrected
from koopdqn.run_folder import DEMONSTRATIONS, FIT, INTENT, POLICY, TRAINING
from koopdqn.tasks.rollout import Episode
from koopdqn.tasks.workcell import Workcell

NAME = "correct.json"
SHOWN = "waypoints.csv"
_KEPT = (DEMONSTRATIONS, INTENT, TRAINING, FIT)


@dataclass(frozen=True)
class _Learned:
    """A learned path, and all that correcting it needs: the policy, its episode from the nominal start and its bend."""

    policy: Policy
    workcell: Workcell
    limit: int
    episode: Episode
    bend: Bend

    @classmethod
    def read(cls, config: Configuration, source: Path) -> "_Learned":
        policy, about = read_policy(source / POLICY, config.task)
        if policy.frame.unfolding is not None:
            raise BadInputError(f"run: a path to correct must not pass itself, found that of {source} does")
        if differs_from_trained(config.robot, about["robot"]):
            raise BadInputError(f"robot: must be the arm that the run was trained with, found {config.robot.name}")
        limit, workcell = step_limit_of(source), pipeline.open_scene(config)
        controller = policy if policy.bend is None else PolicyAround(policy, policy.bend)
        episode = played(workcell, controller, limit)
        return cls(
            policy, workcell, limit, episode, along(episode, policy.frame) if policy.bend is None else policy.bend
        )

    def corrected(self, waypoints: Array) -> "_Corrected":
        began, start = monotonic(), self.workcell.task.nominal_start
        now = self.bend.through(in_frame(waypoints, start, self.policy.frame), waypoints)
        new = played(self.workcell, PolicyAround(replace(self.policy, bend=now), now), self.limit)
        found = Followed.of(self.episode, new, self.bend, now, waypoints, self.policy.frame)
        return _Corrected(waypoints, now, found, monotonic() - began)


@dataclass(frozen=True)
class _Corrected:
    waypoints: Array
    bend: Bend
    found: Followed
    seconds: float


def run(config: Configuration, folder: Path) -> CommandResult:
    """Correct the run of ``run=``; the new run folder holds the corrected one and ``correct.json``.

    Without waypoints a person at the terminal shows them.

    Raises:
        BadInputError: there are no waypoints and no terminal, or they do not lie along the learned path.
        WorkFailedError: the arm cannot follow the corrected path to the goal.
        PauseRequested: the person quit.
    """
    began, source, given = monotonic(), config.run, config.correct.waypoints
    if given is None:
        require_terminal("waypoints", "give waypoints=[[x,y,z],…] or waypoints=FILE")
    learned = _Learned.read(config, source)
    seconds = monotonic() - began
    made = _shown(learned, source, folder) if given is None else learned.corrected(np.array(given))
    found = made.found
    for name in _KEPT:
        if (source / name).is_file():
            shutil.copyfile(source / name, folder / name)
    write_corrected(folder / POLICY, source / POLICY, made.bend)
    report = CorrectionFile(
        run=str(source),
        task=config.task.name,
        waypoints=made.waypoints.tolist(),
        stretch_m=found.stretch.tolist(),
        moved_mm=float(found.moved.max()) * 1e3,
        missed_mm=float(found.missed.max()) * 1e3,
        followed_mean_mm=_mean_mm(found.inside),
        followed_max_mm=_max_mm(found.inside),
        before_mean_mm=_mean_mm(found.before),
        before_max_mm=_max_mm(found.before),
        behind_mean_mm=_mean_mm(found.behind),
        behind_max_mm=_max_mm(found.behind),
        seconds=seconds + made.seconds,
    ).model_dump(mode="json")
    write_json(folder / NAME, report)
    first, last = found.stretch
    lines = [
        f"corrected       {console.shown_path(source)}",
        f"stretch         {first:.3f} to {last:.3f} m along the path, moved by up to {report['moved_mm']:.1f} mm",
        f"followed        {_said(report['followed_mean_mm'])} mm off the way shown on average,"
        f" {_said(report['followed_max_mm'])} mm at most",
        f"elsewhere       {_said(report['before_max_mm'])} mm off the learned path at most before the stretch,"
        f" {_said(report['behind_max_mm'])} mm behind it",
        f"policy          {console.shown_path(folder / POLICY)}",
        f"report          {console.shown_path(folder / NAME)}",
        *(
            [f"the same again  {_again(source, json.dumps(report['waypoints'], separators=(',', ':')))}"]
            * (given is None)
        ),
    ]
    return CommandResult(report, lines, objective=report["followed_mean_mm"])


def _shown(learned: _Learned, source: Path, folder: Path) -> _Corrected:
    """Return the correction by the waypoints that a person shows, which are kept however it ends."""
    showing = Showing(learned.episode, learned.bend, learned.policy.frame, learned.workcell, folder / SHOWN)
    made = None
    try:
        made = correct_by_keys(showing, learned.workcell.task.name, console.shown_path(folder), learned.corrected)
    finally:
        if made is None and showing.added:
            again = _again(source, console.shown_path(showing.file))
            console.note(f"waypoints shown: {len(showing.added)}, kept; to correct by them: {again}")
    return made


def _again(source: Path, waypoints: str) -> str:
    """Return the command that corrects a run by waypoints, as a shell takes it."""
    given = [f"run={console.shown_path(source)}", f"waypoints={waypoints}"]
    return shlex.join([*program(), "correct", *own_options(), *given])


def _mean_mm(distances: Array) -> float | None:
    return float(distances.mean()) * 1e3 if len(distances) else None


def _max_mm(distances: Array) -> float | None:
    return float(distances.max()) * 1e3 if len(distances) else None


def _said(millimetres: float | None) -> str:
    return "–" if millimetres is None else f"{millimetres:.1f}"
