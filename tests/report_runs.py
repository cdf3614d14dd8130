"""Fabricated finished runs for tests of the report: real demonstrations, a policy of zeros, made-up histories."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from hydra import compose, initialize_config_dir
from parts import Parts, load_parts

from koopdqn.artifact import Artifact, described, write_artifact
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.hdf5 import write_hdf5
from koopdqn.evaluation.metrics import wilson_interval
from koopdqn.evaluation.schema import Baselines
from koopdqn.files import write_json
from koopdqn.resources import conf_dir
from koopdqn.settings import load_settings
from koopdqn.tasks.knife import KnifeTask
from koopdqn.tasks.start_frame import STILL
from koopdqn.tasks.task import Task

SHA = "0" * 64
CAUSES = ("unreachable", "posture_jump", "collision", "rule_broken", "stuck", "step_limit")


def about(parts: Parts, seed: int) -> dict[str, Any]:
    """Return a policy's metadata, as training writes it."""
    names = {"task": parts.task, "intent": parts.intent, "trust": parts.trust, "agent": parts.agent}
    names |= {"robot": parts.arm, "reward": parts.reward, "feedback": parts.feedback, "train": parts.train}
    described_parts = {name: described(settings) for name, settings in names.items()}
    # What decides when a training stops shapes no byte of what it does until then.
    for key in ("stop", "extend", "max_steps", "max_episodes"):
        del described_parts["train"][key]
    # The start frame is fitted to the demonstrations of the run, which are of its seed.
    frame = {**STILL.described(), "start": [0.1 * seed, 0.0, 0.0]}
    made_from = {"demonstrations": SHA, "intent": SHA}
    return {"seed": seed, "made_from": made_from, "network": {}, "frame": frame, **described_parts}


def knife_parts() -> Parts:
    """Return the default config's parts with the knife task, which the others' type does not know."""
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        config = compose("config", overrides=["task=knife"])
    return replace(load_parts(), task=load_settings(config.task, KnifeTask, "task"))  # type: ignore[arg-type]  # a shelf


def train_report(parts: Parts, seed: int, episodes: int = 60) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    checks = [{"updates": 250 * i, "env_steps": 9000 * i, "episodes": 20 * i} for i in range(1, 4)]
    return {
        "task": parts.task.name,
        "seed": seed,
        "agent": parts.agent.name,
        "intent": parts.intent.name,
        "learned": seed != 1,
        "learned_at_env_steps": 27000 if seed != 1 else None,
        "seconds": 10.0 + seed,
        "episodes": episodes,
        "env_steps": 27000,
        "updates": 750,
        "oracle_queries": 12 + seed,
        "trusted_fraction": 0.75,
        "reward_agreement": {"trusted": 0.99, "certified": None, "remembered": None, "asked": None},
        "rewards_given": {"trusted": 9, "certified": 0, "remembered": 0, "asked": 3},
        "budget_spent": False,
        "answered_instead": 0,
        "contradictions": 0,
        "rewards_recomputed": 0,
        "reward_per_episode": rng.normal(15, 4, episodes).tolist(),
        "steps_per_episode": [40] * episodes,
        "exploring_episode": (rng.random(episodes) < 0.8).tolist(),
        "best_success_rate": 1.0,
        "best_update": 750,
        "step_limit": 700,
        "checks": [{**check, "success_rate": 1.0, "intent_distance": 2.0, "failures": {}} for check in checks],
        "threads": 1,
        "made_from": {"demonstrations": SHA, "intent": SHA},
    }


def method(mean: float) -> dict[str, Any]:
    summary = {"mean": mean, "max": 2 * mean}
    return {
        "success_rate": 0.9,
        "success_interval_95": list(wilson_interval(9, 10)),
        "measured_episodes": 10,
        "path_deviation_mm": {"mean": mean, "max": 3 * mean, "p95_of_max": 2 * mean, "frechet": mean},
        "stairs_deviation_mm": {"mean": 2 * mean, "max": 6 * mean, "p95_of_max": 4 * mean},
        "lateral_deviation_mm": {"mean": mean, "max": 3 * mean, "p95_of_max": 2 * mean},
        "rotation_deviation_deg": summary,
        "tube_fraction": 1.0,
        "final_position_error_mm": summary,
        "final_rotation_error_deg": summary,
        "path_length_ratio": 1.1,
        "steps": summary,
        "time_stretch": {"mean": 1.0, "max": 1.5},
        "failures": {cause: int(cause == "collision") for cause in CAUSES},
        "turn": None,
        "task_measures": {},
    }


def eval_report(task: Task, run: str) -> dict[str, Any]:
    baselines = {name: method(20.0) for name in Baselines.model_fields}
    rest: dict[str, Any] = {"episodes": 10, "seed": 2000, "start_scale": 1.0, "redrawn_starts": 0, "step_limit": 700}
    rest |= {"dynamics": None, "holdout": None}
    return {**method(5.0), **rest, "task": task.name, "baselines": baselines, "run": run}


def write_run(folder: Path, parts: Parts, demonstrations: Demonstrations, seed: int = 0, age: int = 0) -> Path:
    """Write a finished training run; a larger age makes it older."""
    write_json(folder / "train.json", train_report(parts, seed))
    write_hdf5(folder / "demos.hdf5", demonstrations)
    arrays = {"layer.weight": np.zeros((2, 2), dtype=np.float32)}
    write_artifact(folder / "policy.safetensors", Artifact("policy", arrays, about(parts, seed)))
    _date(folder / "train.json", age)
    return folder


def write_evaluation(folder: Path, parts: Parts, run: str, age: int = 0) -> Path:
    write_json(folder / "eval.json", eval_report(parts.task, run))
    _date(folder / "eval.json", age)
    return folder / "eval.json"


def _date(file: Path, age: int) -> None:
    os.utime(file, (1_700_000_000 - age, 1_700_000_000 - age))


def first(demonstrations: Demonstrations, count: int) -> Demonstrations:
    """Return the first few demonstrations of a set."""
    items: Sequence[Any] = demonstrations.items[:count]
    return Demonstrations(demonstrations.task, demonstrations.arm, items)


def write_swept(folder: Path, parts: Parts, seed: int, *overrides: str, finished: bool = True) -> None:
    """Write what a job of a sweep leaves: its overrides and, if it is finished, its report."""
    given = ["task=shelf", *overrides, f"seed={seed}", "command=train", f"out={folder}"]
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text("".join(f"- {item}\n" for item in given))
    if finished:
        write_json(folder / "train.json", train_report(parts, seed))
