import numpy as np
from parts import Parts, load_parts

from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.intent.fit import Fitted, fit
from koopdqn.intent.validation import convergence, cross_validate
from koopdqn.pose import Array
from koopdqn.tasks.start_frame import StartFrame


def test_the_default_model_comes_to_the_goal_even_from_wide_starts(fitted: Fitted) -> None:
    assert fitted.report["converges"]
    assert fitted.report["converging_share"] == 1.0
    assert fitted.report["converging_share_wide"] >= 0.95


def test_the_papers_model_is_said_not_to_converge(
    demonstrations: Demonstrations, paper: Parts, trajectories: list[Array], fitted: Fitted
) -> None:
    report = fit(demonstrations, paper.task, paper.intent, paper.trust, paper.reward).report
    assert not report["converges"]
    model = paper.intent.fit(trajectories, paper.task)
    assert convergence(model, fitted.trust, trajectories, paper.task)[0] < 1.0


def test_convergence_counts_where_paths_really_end(parts: Parts, trajectories: list[Array], fitted: Fitted) -> None:
    """A frame whose goal is another leads to the goal within the frame, and nowhere else."""
    task = parts.task
    goal = task.goal[:3] + np.array([0.0, 0.05, 0.0])
    elsewhere = fitted.model.within(StartFrame(task.nominal_start[:3], goal, follows=True))
    demonstrated, wide = convergence(elsewhere, fitted.trust, trajectories, task)
    starts = task.draw_starts(np.random.default_rng(1), 20)
    ends = elsewhere.intended_paths(starts, 800, task.step_m)[-1]
    share = float((np.linalg.norm(ends[:, :3] - task.goal[:3], axis=1) <= task.goal_tolerance_m).mean())
    assert share < 1.0
    assert demonstrated < 1.0
    assert wide < 0.5


def test_the_ridge_is_the_one_of_least_multi_step_error(trajectories: list[Array], parts: Parts) -> None:
    hopeless = load_parts("intent=fourier").intent.model_copy(update={"ridge": (1e3, 1e-6)})
    found = cross_validate(trajectories[:3], parts.task, hopeless)
    assert found.ridge == 1e-6
    assert found.multi_step[1e3] > 2 * found.multi_step[1e-6]
    assert len(found.folds) == 3
