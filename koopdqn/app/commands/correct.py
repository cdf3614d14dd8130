"""``koopdqn correct``: lead a stretch of a learned path through waypoints; the rest stays as it is."""

import shutil
from dataclasses import replace
from pathlib import Path
from time import monotonic

import numpy as np

from koopdqn import console
from koopdqn.app.commands import pipeline
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.commands.eval import step_limit_of
from koopdqn.app.commands.pipeline import POLICY
from koopdqn.app.commands.train import REPORT
from koopdqn.app.result import CommandResult
from koopdqn.errors import BadInputError
from koopdqn.evaluation.correction import CorrectionFile, Followed, along, played
from koopdqn.files import write_json
from koopdqn.pose import Array

NAME = "correct.json"
_KEPT = (pipeline.DEMONSTRATIONS, pipeline.INTENT, REPORT, "fit.json")


def run(config: Configuration, folder: Path) -> CommandResult:
    """Correct the run of ``run=``; the new run folder holds the corrected one and ``correct.json``.

    Raises:
        BadInputError: no waypoints are shown, or they do not lie along the learned path.
        WorkFailedError: the arm cannot follow the corrected path to the goal.
    """
    from koopdqn.rl.around import PolicyAround
    from koopdqn.rl.policy import read_policy, write_corrected

    began, source = monotonic(), config.inputs.run
    if source is None or config.correct.waypoints is None:
        raise BadInputError(
            "waypoints: must show the better way, as [[x,y,z],…] or a CSV file of positions, found none"
        )
    policy, _ = read_policy(source / POLICY, config.task)
    limit, workcell = step_limit_of(source / REPORT), pipeline.open_scene(config)
    waypoints: Array = np.array(config.correct.waypoints)
    learned = policy if policy.bend is None else PolicyAround(policy, policy.bend)
    old = played(workcell, learned, limit)
    was = along(old) if policy.bend is None else policy.bend
    now = was.through(waypoints)
    new = played(workcell, PolicyAround(replace(policy, bend=now), now), limit)
    found = Followed.of(old, new, was, now, waypoints)
    for name in _KEPT:
        if (source / name).is_file():
            shutil.copyfile(source / name, folder / name)
    write_corrected(folder / POLICY, source / POLICY, now)
    report = CorrectionFile(
        run=str(source),
        task=config.task.name,
        waypoints=waypoints.tolist(),
        stretch_m=found.stretch.tolist(),
        moved_mm=float(found.moved.max()) * 1e3,
        missed_mm=float(found.missed.max()) * 1e3,
        followed_mean_mm=_mean_mm(found.inside),
        followed_max_mm=_max_mm(found.inside),
        before_mean_mm=_mean_mm(found.before),
        before_max_mm=_max_mm(found.before),
        behind_mean_mm=_mean_mm(found.behind),
        behind_max_mm=_max_mm(found.behind),
        seconds=monotonic() - began,
    ).model_dump(mode="json")
    write_json(folder / NAME, report)
    first, last = found.stretch
    lines = [
        f"corrected       {console.shown_path(source)}",
        f"stretch         {first:.3f} to {last:.3f} m along the path, moved by up to {report['moved_mm']:.1f} mm",
        f"followed        {report['followed_mean_mm']:.1f} mm off the way shown on average,"
        f" {report['followed_max_mm']:.1f} mm at most",
        f"elsewhere       {report['before_max_mm']:.1f} mm off the learned path at most before the stretch,"
        f" {report['behind_max_mm']:.1f} mm behind it",
        f"policy          {console.shown_path(folder / POLICY)}",
        f"report          {console.shown_path(folder / NAME)}",
    ]
    return CommandResult(report, lines, objective=report["followed_mean_mm"])


def _mean_mm(distances: Array) -> float:
    return float(distances.mean()) * 1e3 if len(distances) else 0.0


def _max_mm(distances: Array) -> float:
    return float(distances.max(initial=0.0)) * 1e3
