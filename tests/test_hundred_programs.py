"""A hundred learned paths, a hundred programs, of both tasks; slow, run by `make learn`."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from program_reader import read_joint_trajectory, read_servoj
from test_programs import assert_follows, assert_within_limits

from koopdqn.app import api
from koopdqn.pose import Array
from koopdqn.programs.program import make_program
from koopdqn.programs.ros import write_json_trajectory
from koopdqn.programs.settings import LOOKAHEAD_S, ProgramSettings
from koopdqn.programs.urscript import write_servoj
from koopdqn.rl.policy import Policy
from koopdqn.tasks.workcell import Workcell

STARTS = 100
SEED = 4000
"""Of the starts; no training, check or evaluation draws with it."""


def check_program(
    cell: Workcell, policy: Policy, settings: ProgramSettings, limit: int, start: Array, folder: Path
) -> float:
    """Make the program from joint angles (n,) [rad], assert all it must keep, and return how long it takes [s]."""
    given = make_program(cell, policy, settings.model_copy(update={"start": tuple(start.tolist())}), limit)
    assert given.execution.contact_steps == 0
    write_servoj(folder / "program.script", given)
    first, stream = read_servoj(folder / "program.script")
    np.testing.assert_allclose(first, start, atol=1e-9)
    assert_within_limits(stream, given.limits)
    assert_follows(stream.joints, given.smooth)
    write_json_trajectory(folder / "trajectory.json", given)
    _, positions, _, _ = read_joint_trajectory(folder / "trajectory.json")
    count = len(positions.joints)
    np.testing.assert_allclose(positions.joints, stream.joints[:count], atol=1e-9)
    np.testing.assert_allclose(positions.times, stream.times[:count], atol=1e-8)
    # The last is held until the arm, which follows behind, has come to it.
    np.testing.assert_array_equal(stream.joints[count:], stream.joints[-1:].repeat(len(stream.joints) - count, axis=0))
    assert stream.times[-1] - stream.times[count - 1] >= LOOKAHEAD_S - 1e-9
    return float(stream.times[-1])


@pytest.mark.slow
@pytest.mark.parametrize("task", ["shelf", "knife"])
def test_every_learned_path_becomes_a_program(task: str, tmp_path: Path) -> None:
    config = api.load_config(f"task={task}")
    demonstrations = api.generate(config)
    trained = api.train(config, demonstrations, api.fit(config, demonstrations))
    assert trained.learned
    cell = api.open_workcell(config)
    _, starts, _ = cell.reachability.draw_starts(config.task, np.random.default_rng(SEED), STARTS)
    refused: Counter[str] = Counter()
    for start in starts:
        try:
            check_program(cell, trained.policy, config.program, trained.step_limit, start, tmp_path)
        except Exception as error:
            refused[f"{type(error).__name__}: {error}"[:200]] += 1
    assert not refused, refused
