"""Stands in for the commands that an experiment's runs are made with, and small experiments."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from experiment import Experiment

from koopdqn.app.hydra.overrides import prepare

SHA = "0" * 64
METHOD: dict[str, Any] = {
    "success_rate": 0.9,
    "path_deviation_mm": {"mean": 5.0, "p95_of_max": 14.0},
    "rotation_deviation_deg": {"mean": 2.0, "max": 3.0},
    "failures": {"collision": 10},
}
CONTENT: dict[str, Any] = {
    "page": "page.md",
    "folder": "runs",
    "seeds": [1, 2],
    "train": ["seed={seed}"],
    "measure": ["eval.seed=40", "eval.baselines=false"],
    "cases": {"shelf": {"train": ["task=shelf"]}, "knife": {"train": ["task=knife"]}},
    "variants": {
        "default": {"about": "the default", "measure": ["eval.baselines=true"], "baselines": {"greedy": "greedy on K"}},
        "sign": {"train": ["reward.shape=sign"], "undoes": [5]},
        "wide": {"of": "default", "measure": ["eval.start_scale=3.0"]},
        "dmp": {"about": "a DMP", "of": "default", "by": "dmp", "seeds": [1]},
    },
    "values": {
        "learned": "train.learned",
        "success_rate": "eval.success_rate",
        "deviation_mm": "eval.holdout.hausdorff_mm.policy.0 or eval.path_deviation_mm.mean",
        "oracle_queries": "train.oracle_queries",
        "demonstrations": "train.made_from.demonstrations",
    },
    "tables": {"part": [{"labels": {"what": "about"}, "columns": {"success [%]": {"value": "success_rate"}}}]},
}
PAGE = "above\n\n<!-- begin: part -->\n<!-- end: part -->\n\nbelow\n"


def experiment(**changed: Any) -> Experiment:
    return Experiment.model_validate({**CONTENT, **changed})


def write(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content), encoding="utf-8")


@dataclass
class Launcher:
    """Notes what it is told and leaves the files that the commands would."""

    train_status: int = 0
    demonstrations: str = SHA
    calls: list[tuple[str, list[str]]] = field(default_factory=list)

    def __call__(self, command: str, arguments: Sequence[str], output: Path) -> int:
        self.calls.append((command, list(arguments)))
        given = dict(item.partition("=")[::2] for item in arguments)
        folder = Path(given["out"] if "out" in given else given["run"])
        made_from = {"demonstrations": self.demonstrations}
        if command == "imitate":
            settings = [item for item in arguments if not item.startswith(("run=", "out="))]
            about = {"seconds": 3.0, "oracle_queries": 0, "made_from": made_from, "settings": settings}
            write(folder / "imitation.json", about)
        elif "out" in given:
            # JSON is YAML, which Hydra records the overrides in.
            write(folder / ".hydra" / "overrides.yaml", prepare(command, arguments).overrides)
        if command != "train":
            baselines = {"greedy": METHOD, "floor": METHOD}
            shown = baselines if given.get("eval.baselines", "true") == "true" else None
            held_out = {"hausdorff_mm": {"policy": [31.0]}} if "held-out" in str(folder) else None
            write(folder / "eval.json", {**METHOD, "baselines": shown, "holdout": held_out})
            return 0
        if self.train_status < 2:
            learned = self.train_status == 0
            report: dict[str, Any] = {
                "learned": learned,
                "learned_at_env_steps": 100 if learned else None,
                "checks": [],
            }
            agreement = {"trusted": 0.99, "remembered": None}
            report |= {"oracle_queries": 7, "seconds": 30.0, "reward_agreement": agreement, "made_from": made_from}
            write(folder / "train.json", report)
        return self.train_status
