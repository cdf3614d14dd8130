from pathlib import Path
from typing import Any

import numpy as np
import pytest
from parts import load_parts

from koopdqn.artifact import Artifact, described, write_artifact
from koopdqn.errors import BadInputError
from koopdqn.rl.checkpoint import read_checkpoint, save_checkpoint
from koopdqn.run_folder import CHECKPOINT

SHAPED_BY: dict[str, Any] = {"seed": 0, "task": {"name": "shelf"}}


class _Stub:
    """Something with a trainer's state."""

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        return {"learner/updates": np.array(7)}, {"counters": {"questions": 3}, "rng": {"state": 2**127 + 1}}


def saved(folder: Path) -> None:
    save_checkpoint(folder, _Stub(), SHAPED_BY, 12.5)  # type: ignore[arg-type]  # only its state is used


def test_a_run_without_a_checkpoint_begins_anew(tmp_path: Path) -> None:
    assert read_checkpoint(tmp_path, SHAPED_BY) is None


def test_a_checkpoint_holds_state_and_time(tmp_path: Path) -> None:
    saved(tmp_path)
    found = read_checkpoint(tmp_path, dict(reversed(list(SHAPED_BY.items()))))
    assert found is not None
    assert int(found.arrays["learner/updates"]) == 7
    assert found.about["state"] == _Stub().state()[1]
    assert found.about["seconds"] == 12.5


def test_a_run_of_another_config_is_refused(tmp_path: Path) -> None:
    saved(tmp_path)
    with pytest.raises(BadInputError, match="can only go on with the config it began with"):
        read_checkpoint(tmp_path, SHAPED_BY | {"seed": 1})


def test_what_is_another_is_named_with_both_values_and_a_long_list_is_cut(tmp_path: Path) -> None:
    began = {"agent": {"gamma": 0.5, "hidden": [128, 128], **{f"n{i}": 0 for i in range(9)}}, "made_from": "a" * 99}
    save_checkpoint(tmp_path, _Stub(), began, 1.0)  # type: ignore[arg-type]  # only its state is used
    with pytest.raises(BadInputError) as refused:
        read_checkpoint(tmp_path, {**began, "agent": {**began["agent"], "gamma": 0.8, "hidden": [64]}})  # type: ignore[dict-item]
    assert str(refused.value).endswith("found agent.gamma 0.8 instead of 0.5; agent.hidden [64] instead of [128,128]")
    with pytest.raises(BadInputError, match=r"found agent.hidden.1 true instead of 128; size 1 instead of nothing$"):
        read_checkpoint(tmp_path, {**began, "agent": {**began["agent"], "hidden": [128, True]}, "size": 1})  # type: ignore[dict-item]
    with pytest.raises(BadInputError) as refused:
        read_checkpoint(tmp_path, {"agent": dict.fromkeys(began["agent"], 1), "made_from": "b" * 99})
    assert str(refused.value).endswith("; agent.n1 1 instead of 0; and 8 more")


def test_a_damaged_checkpoint_is_refused(tmp_path: Path) -> None:
    saved(tmp_path)
    path = tmp_path / CHECKPOINT
    path.write_bytes(path.read_bytes()[:-4])
    with pytest.raises(BadInputError, match="must be a whole artifact"):
        read_checkpoint(tmp_path, SHAPED_BY)


def test_an_artifact_of_another_kind_in_its_place_is_refused(tmp_path: Path) -> None:
    write_artifact(tmp_path / CHECKPOINT, Artifact("policy", {}, {}))
    with pytest.raises(BadInputError, match="must be of kind checkpoint, found kind policy"):
        read_checkpoint(tmp_path, SHAPED_BY)


def test_a_run_goes_on_that_names_its_augmentation_by_the_old_key(tmp_path: Path) -> None:
    intent = described(load_parts("intent=fourier").intent)
    old = {("stabilisation" if key == "augmentation" else key): value for key, value in intent.items()}
    save_checkpoint(tmp_path, _Stub(), SHAPED_BY | {"intent": old}, 1.0)  # type: ignore[arg-type]  # only its state is used
    assert read_checkpoint(tmp_path, SHAPED_BY | {"intent": intent}) is not None
