"""The runner that tries to break koopdqn sees what breaks, and counts it."""

import json
import os
import resource
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import prove
import pytest
from helpers_shelf import shelf
from hypothesis import given
from hypothesis import strategies as st
from prove import Case, Watched
from prove_fuzz import mutated
from prove_physics import CONDITIONS, Condition


def _spin() -> tuple[str, str]:
    while True:
        pass


def _die() -> tuple[str, str]:
    os._exit(9)


def _grow() -> tuple[str, str]:
    # More than this process ever held, which may be much more than it holds now.
    held = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10
    return "done", str(len(b"x" * (held + (1 << 28))))


def _fail() -> tuple[str, str]:
    raise KeyError("nowhere")


ENDS: list[tuple[Callable[[], tuple[str, str]], str]] = [
    (lambda: ("refused", "x"), "refused"),
    (_fail, "wrong"),
    (_spin, "hang"),
    (_die, "crash"),
    (_grow, "memory"),
    (lambda: ("done", ""), "done"),
]


def test_every_end_is_seen_and_the_next_case_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    # Long enough to grow by what a large process holds, on a busy machine.
    monkeypatch.setattr(prove, "LONGEST_S", 4.0)
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10
    monkeypatch.setattr(prove, "MOST_BYTES", used + (1 << 27))
    watched = Watched(lambda number: Case("family", str(number), ENDS[number][0]))
    order = range(len(ENDS))
    found = dict(watched.results(iter(order), time.monotonic() + 300))
    assert [found[number]["end"] for number in order] == [ENDS[number][1] for number in order]
    assert "KeyError" in found[1]["detail"]


@given(content=st.binary(max_size=200), seed=st.integers(0, 1000))
def test_damage_is_the_same_for_the_same_seed(content: bytes, seed: int) -> None:
    assert mutated(content, np.random.default_rng(seed)) == mutated(content, np.random.default_rng(seed))


def test_counts_of_seeds_are_summed_and_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = tmp_path / "page.md"
    parts = "".join(f"<!-- begin: {name} -->\n<!-- end: {name} -->\n" for name in ("fuzz", "soak", "physics"))
    page.write_text(parts)
    monkeypatch.setattr(prove, "PAGE", page)
    monkeypatch.setattr(prove, "KNOWN", tmp_path / "known.json")
    prove.write_counts("fuzz", 1, Counter({("files", "done"): 2, ("files", "hang"): 1}), fresh=False)
    prove.write_counts("fuzz", 2, Counter({("files", "refused"): 4}), fresh=False)
    assert "| files | 7 | 2 | 4 | 0 | 1 | 0 | 0 | 0 |" in page.read_text()
    prove.write_counts("fuzz", 2, Counter({("files", "refused"): 3}), fresh=True)
    assert json.loads((tmp_path / "known.json").read_text()) == {"fuzz": {"2": {"files": {"refused": 3}}}}
    assert "| all | 3 | 0 | 3 | 0 | 0 | 0 | 0 | 0 |" in page.read_text()


def test_a_heavier_payload_is_heavier_and_the_planned_scene_is_left_alone() -> None:
    scene = shelf().scene
    before = scene.model.body_mass.copy()
    heavy = Condition(payload=1.3, friction_nm=2.0).scene(scene)
    ratio = heavy.model.body_mass / np.maximum(before, 1e-12)
    assert set(np.round(ratio[before > 0], 6)) == {1.0, 1.3}
    assert (heavy.model.dof_frictionloss[heavy.velocity_index] == 2.0).all()
    np.testing.assert_array_equal(scene.model.body_mass, before)
    assert not scene.model.dof_frictionloss.any()


def test_a_dropped_command_is_the_one_before() -> None:
    sent = np.arange(600.0).reshape(100, 6)
    got = Condition(dropped=0.3).commanded(np.random.default_rng(0))(sent)
    late = np.flatnonzero((got != sent).any(axis=1))
    assert 10 < len(late) < 60
    np.testing.assert_array_equal(got[late], got[late - 1])
    np.testing.assert_array_equal(CONDITIONS["nominal"].commanded(np.random.default_rng(0))(sent), sent)
