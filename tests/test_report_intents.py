from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from parts import load_parts
from report_runs import first

from koopdqn.report.intents import SAMPLES, study
from koopdqn.report.numbers import spread

if TYPE_CHECKING:
    from parts import Parts

    from koopdqn.demonstrations.dataset import Demonstrations
    from koopdqn.intent.model import IntentModel
    from koopdqn.pose import Array


def test_errors_of_the_held_out_demonstrations_are_those_of_the_cross_validation(
    demonstrations: "Demonstrations", paper: "Parts"
) -> None:
    three = first(demonstrations, 3)
    found = [study(three, paper.task, paper.intent, paper.trust, paper.reward, shown) for shown in range(3)]
    errors = np.concatenate([item.held_out.error[:, 0] for item in found])
    sixty = np.concatenate([item.held_out.sixty[:, 0] for item in found])
    report = found[0].report
    assert errors.max() == pytest.approx(report["one_step_error_m"]["max"], rel=1e-9)
    assert np.sqrt((errors**2).mean()) == pytest.approx(report["one_step_error_m"]["rms"], rel=1e-9)
    assert sixty.max() == pytest.approx(report["sixty_samples"]["max_m"], rel=1e-9)
    assert [len(item.held_out.sixty) for item in found] == [SAMPLES - 1] * 3


def test_the_expert_is_asked_where_the_trust_domain_of_the_others_ends(
    demonstrations: "Demonstrations", trajectories: "list[Array]", parts: "Parts"
) -> None:
    intent, box = load_parts("intent=paper").intent, load_parts("trust=box").trust

    def asked(**changes: object) -> np.ndarray:
        trust = box.model_copy(update=changes)
        return study(first(demonstrations, 3), parts.task, intent, trust, parts.reward).held_out.asked

    assert not asked(sigmas=1e3, least_right=0.0).any()
    narrow, wide = asked(sigmas=0.5, least_right=0.0), asked(sigmas=1.0, least_right=0.0)
    assert len(narrow) == len(trajectories[0]) - 1
    # What a narrow domain holds a wide one holds as well.
    assert narrow[wide].all()
    assert narrow.sum() > wide.sum()


def test_a_study_validates_once(
    demonstrations: "Demonstrations", paper: "Parts", monkeypatch: pytest.MonkeyPatch
) -> None:
    fits: list[int] = []
    kind = type(paper.intent)
    fitted = kind.fit

    def counted(*given: Any) -> "IntentModel":
        fits.append(len(given[1]))
        return fitted(*given)

    monkeypatch.setattr(kind, "fit", counted)
    three = first(demonstrations, 3)
    study(three, paper.task, paper.intent, paper.trust, paper.reward)
    # The whole and, in sixty samples, the fold that is shown; those of the cross-validation are fitted together.
    assert sorted(fits) == [2, 3]


def test_a_study_is_json(demonstrations: "Demonstrations", paper: "Parts") -> None:
    import json

    found = study(demonstrations, paper.task, paper.intent, paper.trust, paper.reward, 1)
    content = json.loads(json.dumps(found.content(), allow_nan=False))
    assert content["held_out"]["demonstration"] == 1
    assert content["held_out"]["one_step_error_m"] == found.held_out.error[:, 0].tolist()


def test_spread_is_mean_and_range() -> None:
    assert spread([1.0, None, 3.0], ".1f", unit="mm") == "2.0 (1.0–3.0) mm"
    assert spread([0.5, 0.5], ".0f", 100.0, "%") == "50 %"
    assert spread([0.991, 0.992], ".0f", 100.0) == "99"
    assert spread([None], ".1f", unit="mm") == "–"
