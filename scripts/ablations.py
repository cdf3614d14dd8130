"""Measures what the method's ideas add, by leaving out one at a time: `make ablations`.

Every variant of the config is trained and evaluated with every seed, in runs/ablations/TASK/VARIANT/SEED/{train,eval};
what is finished there is not done again, and an interrupted training goes on from its checkpoint. The results go to
runs/ablations/ablations.json, one row a run, and as tables to docs/ablations.md.

A training that does not learn within its limit is a result like any other. Exit status 0 if every run came to a
result, 1 if a command crashed (its output lies beside the run; the other runs are still made), 2 bad input.
"""

import argparse
import os
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import measured_runs
from ablation_tables import Row, with_tables
from ablation_variants import VARIANTS, Variant
from measured_runs import Command, Launch, Training, add_jobs, launch

from koopdqn import console
from koopdqn.errors import BadInputError
from koopdqn.exit_status import guard
from koopdqn.files import read_json, write_json, write_text

FOLDER: Final = Path("runs") / "ablations"
PAGE: Final = Path("docs") / "ablations.md"

TASKS: Final = ("shelf", "knife")
SEEDS: Final = (0, 1, 2)
EVALUATION: Final = ("eval.dynamics=false", "eval.baselines=false")


@dataclass(frozen=True)
class Run:
    """A variant with a seed on a task, and where its results lie.

    Attributes:
        task: name of the task.
        variant: what is changed.
        seed: of the training.
        root: folder of the runs.
    """

    task: str
    variant: Variant
    seed: int
    root: Path = FOLDER

    @property
    def folder(self) -> Path:
        """The folder that holds the run's training and evaluation."""
        return self.root / self.task / self.variant.name / str(self.seed)

    @property
    def name(self) -> str:
        """What the run is called in messages."""
        return f"{self.task} {self.variant.name} seed {self.seed}"

    @property
    def overrides(self) -> list[str]:
        """What the training is given beside its run folder."""
        limit = f"train.max_steps={self.variant.most_actions}"
        return [f"task={self.task}", *self.variant.overrides, limit, f"seed={self.seed}"]

    @property
    def training(self) -> Training:
        """Its training."""
        return Training(self.folder / "train", tuple(self.overrides), self.folder)

    def commands(self) -> list[Command]:
        """Return what is left to do: names and arguments of the koopdqn commands, none if the run is finished.

        Raises:
            BadInputError: the folder holds a training with other overrides.
        """
        measured, left = self.folder / "eval", self.training.commands()
        if not left and (measured / "eval.json").is_file():
            return []
        return [*left, ("eval", [f"run={self.training.folder}", f"out={measured}", *EVALUATION])]

    def row(self) -> Row | None:
        """Return the result, or None if the run is not finished."""
        if self.commands():
            return None
        trained = read_json(self.folder / "train" / "train.json", "the training report")
        measured = read_json(self.folder / "eval" / "eval.json", "the evaluation report")
        same = ("learned", "episodes", "env_steps", "updates", "oracle_queries", "seconds", "reward_agreement")
        return Row(
            task=self.task,
            variant=self.variant.name,
            seed=self.seed,
            overrides=[item for item in self.overrides if item.partition("=")[0] not in ("task", "seed")],
            **{name: trained[name] for name in same},
            success_rate=measured["success_rate"],
            path_deviation_mm=measured["path_deviation_mm"]["mean"],
            lateral_deviation_mm=measured["lateral_deviation_mm"]["mean"],
            failures={cause: count for cause, count in measured["failures"].items() if count},
            evaluated=measured["episodes"],
        )


def runs_of(tasks: Iterable[str], variants: Sequence[Variant], seeds: Sequence[int], root: Path = FOLDER) -> list[Run]:
    """Return the runs in their order: all variants with one seed, then the next, so that an early end is fair."""
    return [Run(task, variant, seed, root) for task in tasks for seed in seeds for variant in variants]


def write_results(root: Path = FOLDER, page: Path = PAGE) -> list[Row]:
    """Write ablations.json and the page's tables from every finished run; return the rows.

    Raises:
        BadInputError: the page cannot be read or lacks its markers, or a run was made with other overrides.
    """
    finished = [run.row() for run in runs_of(TASKS, VARIANTS, SEEDS, root)]
    rows = [row for row in finished if row is not None]
    write_json(root / "ablations.json", [asdict(row) for row in rows])
    try:
        text = page.read_text(encoding="utf-8")
    except OSError as error:
        raise BadInputError(f"{page} must be readable, the system says: {error.strerror}") from error
    write_text(page, with_tables(text, rows))
    return rows


def measure(runs: Sequence[Run], launch: Launch = launch, jobs: int = 1) -> int:
    """Carry out what is left of the runs, telling what came of each; return the exit status.

    Raises:
        BadInputError: the folder of a run holds a training with other overrides.
    """

    def finished(run: Run) -> None:
        if (row := run.row()) is not None:
            verdict = "learned" if row.learned else "not learned"
            console.note(f"{run.name}: {verdict}, success {row.success_rate:.0%}, {row.oracle_queries} questions")

    return measured_runs.measure("Ablations", runs, finished, launch, jobs=jobs)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure what the arguments name, and write all that is measured so far."""
    names = [variant.name for variant in VARIANTS]
    parser = argparse.ArgumentParser(description="Measure what the method's ideas add, by leaving out one at a time.")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=["shelf"], help="default: shelf")
    parser.add_argument("--variants", nargs="+", choices=names, default=names, metavar="NAME", help="default: all")
    parser.add_argument("--seeds", nargs="+", type=int, choices=SEEDS, default=list(SEEDS), help="default: all")
    add_jobs(parser)
    given = parser.parse_args(arguments)
    chosen = [variant for variant in VARIANTS if variant.name in given.variants]

    def work() -> int:
        os.chdir(Path(__file__).resolve().parents[1])
        try:
            return measure(runs_of(given.tasks, chosen, given.seeds), jobs=given.jobs)
        finally:
            write_results()

    return guard(work, debug=False)


if __name__ == "__main__":
    sys.exit(main())
