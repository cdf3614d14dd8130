from pathlib import Path

import numpy as np
import pytest
from parts import Parts, with_fields

from koopdqn import artifact
from koopdqn.errors import BadInputError
from koopdqn.intent.fit import Fitted
from koopdqn.intent.storage import KIND, StoredIntent, read_intent
from koopdqn.pose import Array


@pytest.fixture
def stored(fitted: Fitted, parts: Parts) -> StoredIntent:
    return StoredIntent(fitted.model, fitted.trust, parts.intent, "f" * 64)


@pytest.mark.parametrize("name", ["intent.npz", "intent.safetensors"])
def test_a_stored_intent_comes_back_bit_for_bit(
    tmp_path: Path, stored: StoredIntent, parts: Parts, trajectories: list[Array], name: str
) -> None:
    stored.write(tmp_path / name, parts.task)
    found = read_intent(tmp_path / name, parts.task)
    here, steps = trajectories[0], np.arange(len(trajectories[0]))
    np.testing.assert_array_equal(found.model.predict(here), stored.model.predict(here))
    np.testing.assert_array_equal(found.model.predict_step(here, 0.0021), stored.model.predict_step(here, 0.0021))
    np.testing.assert_array_equal(found.trust.contains(here, steps), stored.trust.contains(here, steps))
    assert artifact.described(found.settings) == artifact.described(parts.intent)
    assert found.trust.settings == parts.trust
    assert found.demonstrations == "f" * 64
    assert found.digest() == stored.digest()


def test_the_same_fit_gives_the_same_bytes(tmp_path: Path, stored: StoredIntent, parts: Parts) -> None:
    for name in ("a.npz", "b.npz"):
        stored.write(tmp_path / name, parts.task)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_the_intent_of_another_task_is_refused(tmp_path: Path, stored: StoredIntent, parts: Parts) -> None:
    stored.write(tmp_path / "intent.npz", parts.task)
    with pytest.raises(BadInputError, match="must be of task shelf with the present settings"):
        read_intent(tmp_path / "intent.npz", with_fields(parts.task, variation_m=0.004))


def test_an_edited_intent_is_refused(tmp_path: Path, stored: StoredIntent, parts: Parts) -> None:
    path = tmp_path / "intent.npz"
    stored.write(path, parts.task)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    arrays["trust_radius"] = arrays["trust_radius"] * 2
    np.savez(path, **arrays)
    with pytest.raises(BadInputError, match="changed by hand"):
        read_intent(path, parts.task)


def test_the_digest_is_of_what_decides_predictions(stored: StoredIntent, fitted: Fitted, parts: Parts) -> None:
    same = StoredIntent(fitted.model, fitted.trust, parts.intent, "0" * 64)
    assert same.digest() == stored.digest()
    changed = artifact.Artifact(KIND, stored._arrays(), {})
    changed.arrays["matrix"] = changed.arrays["matrix"] + 1e-12
    assert artifact.arrays_digest(changed.arrays) != stored.digest()
