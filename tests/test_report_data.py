import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from parts import load_parts
from report_runs import first, write_run

from koopdqn.artifact import read_artifact, write_artifact
from koopdqn.intent.separate import SeparateIntentSettings
from koopdqn.report import data
from koopdqn.report.data import HeldOut, held_out
from koopdqn.report.runs import find_runs

if TYPE_CHECKING:
    from parts import Parts

    from koopdqn.demonstrations.dataset import Demonstrations
    from koopdqn.intent.model import IntentModel
    from koopdqn.pose import Array
    from koopdqn.tasks.task import Task

FILE = Path("fits/shelf-paper.json")


def studied(demonstrations: "Demonstrations", parts: "Parts") -> HeldOut:
    return held_out(demonstrations, parts.task, parts.intent, parts.trust, parts.reward, FILE)


def test_errors_of_the_held_out_demonstrations_are_those_of_the_cross_validation(
    demonstrations: "Demonstrations", paper: "Parts", monkeypatch: pytest.MonkeyPatch
) -> None:
    found = []
    for shown in range(3):
        monkeypatch.setattr(data, "SHOWN", shown)
        found.append(studied(first(demonstrations, 3), paper))
    errors = np.concatenate([item.error[:, 0] for item in found])
    sixty = np.concatenate([item.sixty[:, 0] for item in found])
    report = found[0].report
    assert errors.max() == pytest.approx(report["one_step_error_m"]["max"], rel=1e-9)
    assert np.sqrt((errors**2).mean()) == pytest.approx(report["one_step_error_m"]["rms"], rel=1e-9)
    assert sixty.max() == pytest.approx(report["sixty_samples"]["max_m"], rel=1e-9)
    assert [len(item.sixty) for item in found] == [59] * 3


def test_the_expert_is_asked_where_the_trust_domain_of_the_others_ends(
    demonstrations: "Demonstrations", trajectories: "list[Array]", parts: "Parts"
) -> None:
    chosen = replace(parts, intent=load_parts("intent=paper").intent)
    box = load_parts("trust=box").trust

    def asked(**changes: object) -> np.ndarray:
        return studied(first(demonstrations, 3), replace(chosen, trust=box.model_copy(update=changes))).asked

    assert not asked(sigmas=1e3, least_right=0.0).any()
    narrow, wide = asked(sigmas=0.5, least_right=0.0), asked(sigmas=1.0, least_right=0.0)
    assert len(narrow) == len(trajectories[0]) - 1
    # What a narrow domain holds a wide one holds as well.
    assert narrow[wide].all()
    assert narrow.sum() > wide.sum()


def test_nothing_is_fitted_beside_the_cross_validation(
    demonstrations: "Demonstrations", paper: "Parts", monkeypatch: pytest.MonkeyPatch
) -> None:
    fits: list[int] = []
    fit = SeparateIntentSettings.fit

    def counted(settings: SeparateIntentSettings, trajectories: list["Array"], task: "Task") -> "IntentModel":
        fits.append(len(trajectories))
        return fit(settings, trajectories, task)

    monkeypatch.setattr(SeparateIntentSettings, "fit", counted)
    studied(first(demonstrations, 3), paper)
    # The whole; the models of the others come from the cross-validation.
    assert fits == [3]


def test_the_content_is_json_that_names_its_units(demonstrations: "Demonstrations", paper: "Parts") -> None:
    found = studied(demonstrations, paper)
    content = json.loads(json.dumps(found.content, allow_nan=False))
    assert content["fit"]["intent"] == "paper"
    assert content["held_out"]["demonstration"] == 0
    assert content["held_out"]["one_step_error_m"] == found.error[:, 0].tolist()
    assert content["held_out"]["rescaled_one_step_error_rad"] == found.rescaled[:, 1].tolist()
    assert content["held_out"]["sixty_samples_error_m"] == found.sixty[:, 0].tolist()


def test_a_run_of_another_release_is_left_out(tmp_path: Path, parts: "Parts", demonstrations: "Demonstrations") -> None:
    write_run(tmp_path / "run", parts, first(demonstrations, 2))
    file = tmp_path / "run" / "policy.safetensors"
    policy = read_artifact(file, "policy")
    old = {**policy.about, "intent": {"target": "koopdqn.nowhere.Intent"}}
    write_artifact(file, replace(policy, about=old))
    runs, [left_out] = find_runs([tmp_path])
    assert not runs
    assert "intent.target" in left_out.reason
