"""Corrections of a learned path as a person would show them, and how they are followed: docs/corrections.md's table.

    scripts/corrections.py RUN CONTINUOUS

RUN is a run trained with Table 1's actions, CONTINUOUS one with continuous actions. A correction is four waypoints
beside a stretch of the path that the policy takes from the nominal start.
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from docs import replaced, rows_table
from koopdqn.app.commands import pipeline
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.commands.trained import step_limit_of
from koopdqn.app.hydra.compose import composed
from koopdqn.app.hydra.overrides import prepare
from koopdqn.errors import WorkFailedError
from koopdqn.evaluation.correction import Followed, along, in_base, in_frame, played
from koopdqn.pose import Array
from koopdqn.rl.policy import PolicyAround, read_policy
from koopdqn.run_folder import POLICY

PAGE: Final = Path(__file__).resolve().parents[1] / "docs" / "corrections.md"
_ASIDE_M: Final = np.array([0.024, 0.04, 0.04, 0.024])
_STRETCHES: Final = ((0.15, 0.35), (0.30, 0.50), (0.45, 0.65), (0.60, 0.80))
_WAYS: Final = {f"{sign}{'xyz'[i]}": size * np.eye(3)[i] for i in range(3) for sign, size in (("+", 1.0), ("−", -1.0))}


def corrected(run: Path) -> Iterator[Followed | str]:
    """Yield how each correction of a run is followed, stretch by stretch, or why it cannot be made."""
    config = Configuration.load(composed(prepare("correct", [f"run={run}", "out=unused"]).overrides))
    policy, _ = read_policy(run / POLICY, config.task)
    limit, workcell = step_limit_of(run), pipeline.open_scene(config)
    learned = played(workcell, policy, limit)
    was, start, frame = along(learned, policy.frame), workcell.task.nominal_start, policy.frame
    for first, last in _STRETCHES:
        rows = (np.linspace(first, last, len(_ASIDE_M)) * (len(was.path) - 1)).astype(int)
        for way in _WAYS.values():
            waypoints = in_base(was.path[rows], start, frame) + _ASIDE_M[:, None] * way
            try:
                now = was.through(in_frame(waypoints, start, frame))
                new = played(workcell, PolicyAround(policy, now), limit)
                yield Followed.of(learned, new, was, now, waypoints, frame)
            except WorkFailedError as error:
                yield str(error).partition("found ")[2].partition(" ")[0]


def cells(found: Followed | str) -> list[str]:
    """Return mean and largest distance [mm] from the way shown, then the largest before, and both behind."""
    if isinstance(found, str):
        return [found, "", ""]
    return [_both(found.inside), f"{1e3 * found.before.max(initial=0.0):.1f}", _both(found.behind)]


def _both(distances: Array) -> str:
    return f"{1e3 * distances.mean():.1f} / {1e3 * distances.max():.1f}" if len(distances) else "–"


def main(*runs: str) -> None:
    """Measure both runs and write the table."""
    if len(runs) != 2:
        raise SystemExit(__doc__)
    each = [list(corrected(Path(run))) for run in runs]
    labels = [(f"{first:.0%} to {last:.0%}", name) for first, last in _STRETCHES for name in _WAYS]
    # What neither run can carry out says nothing.
    rows = [
        [*label, *cells(one), *cells(two)]
        for label, one, two in zip(labels, *each, strict=True)
        if not (isinstance(one, str) and isinstance(two, str))
    ]
    heads = "way shown", "before", "behind"
    table = rows_table(
        ["stretch", "aside", *(f"{kind}: {head}" for kind in ("Table 1", "continuous") for head in heads)], rows
    )
    one, two = (max(1e3 * found.missed.max() for found in side if not isinstance(found, str)) for side in each)
    said = f"Waypoints are missed by {one:.1f} mm at most by Table 1's actions and by {two:.1f} mm by continuous ones."
    PAGE.write_text(replaced(PAGE.read_text(encoding="utf-8"), "corrections", f"{table}\n\n{said}"), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
