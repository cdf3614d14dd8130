"""Measures what each deviation from the paper adds, by undoing one at a time: `make ablations`.

Every variant of the config is trained and evaluated in every case with every seed, in
runs/ablations/CASE/VARIANT/SEED/{train,eval}; what is finished there is not done again, and an interrupted training
goes on from its checkpoint. The results go to runs/ablations/ablations.json, one row a run, and as a table to
docs/algorithm.md.

Two of the cases are motions of people, below the folder --people; a set that is not there is left out.

A training that does not learn within its limit is a result like any other. Exit status 0 if every run begun came to a
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
from ablation_tables import Row, with_table
from ablation_variants import CASES, VARIANTS, Case, Variant
from measured_runs import Command, Launch, Training, add_jobs, launch

from koopdqn import console
from koopdqn.app.exit_status import guard
from koopdqn.errors import BadInputError
from koopdqn.files import read_json, write_json, write_text

FOLDER: Final = Path("runs") / "ablations"
PAGE: Final = Path("docs") / "algorithm.md"
PEOPLE: Final = Path("..") / "shared" / "data"

SEEDS: Final = (0, 1, 2)
# Not the seed of starts that results are reported with: these figures say what stays in the code.
EVALUATION: Final = ("eval.dynamics=false", "eval.baselines=false", "eval.seed=40")


@dataclass(frozen=True)
class Run:
    """A variant with a seed in a case, and where its results lie.

    Attributes:
        case: what is learned.
        variant: what is changed.
        seed: of the training.
        people: folder of people's motions.
        root: folder of the runs.
    """

    case: Case
    variant: Variant
    seed: int
    people: Path = PEOPLE
    root: Path = FOLDER

    @property
    def folder(self) -> Path:
        """The folder that holds the run's training and evaluation."""
        return self.root / self.case.name / self.variant.name / str(self.seed)

    @property
    def name(self) -> str:
        """What the run is called in messages."""
        return f"{self.case.name} {self.variant.name} seed {self.seed}"

    @property
    def overrides(self) -> list[str]:
        """What the training is given beside its run folder."""
        demonstrations = [f"demos={self.people / self.case.file}"] if self.case.file else []
        limit = f"train.max_steps={self.variant.most_actions}"
        return [*self.case.overrides, *demonstrations, *self.variant.overrides, limit, f"seed={self.seed}"]

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
        deviation = measured["path_deviation_mm"]["mean"]
        if self.case.file:
            (deviation,) = measured["holdout"]["hausdorff_mm"]["policy"]
        same = ("learned", "episodes", "oracle_queries", "seconds")
        return Row(
            case=self.case.name,
            variant=self.variant.name,
            seed=self.seed,
            overrides=list(self.variant.overrides),
            **{name: trained[name] for name in same},
            trusted_right=trained["reward_agreement"]["trusted"],
            success_rate=measured["success_rate"],
            deviation_mm=deviation,
        )


def cases_found(cases: Iterable[Case], people: Path) -> list[Case]:
    """Return the cases less those sets of people's motions that are not there, which are said."""
    found = []
    for case in cases:
        if case.file and not (people / case.file).is_file():
            console.note(f"{case.name} is left out: {people / case.file} does not exist")
        else:
            found.append(case)
    return found


def runs_of(
    cases: Sequence[Case],
    variants: Sequence[Variant],
    seeds: Sequence[int],
    people: Path = PEOPLE,
    root: Path = FOLDER,
) -> list[Run]:
    """Return the runs in their order: everything with one seed, then the next, so that an early end is fair."""
    return [Run(case, variant, seed, people, root) for seed in seeds for variant in variants for case in cases]


def write_results(people: Path = PEOPLE, root: Path = FOLDER, page: Path = PAGE) -> list[Row]:
    """Write ablations.json and the page's table from every finished run; return the rows.

    Raises:
        BadInputError: the page cannot be read or lacks its part, or a run was made with other overrides.
    """
    finished = [run.row() for run in runs_of(CASES, VARIANTS, SEEDS, people, root)]
    rows = [row for row in finished if row is not None]
    write_json(root / "ablations.json", [asdict(row) for row in rows])
    try:
        text = page.read_text(encoding="utf-8")
    except OSError as error:
        raise BadInputError(f"{page} must be readable, the system says: {error.strerror}") from error
    write_text(page, with_table(text, rows))
    return rows


def measure(runs: Sequence[Run], launch: Launch = launch, minutes: float | None = None, jobs: int = 1) -> int:
    """Carry out what is left of the runs, telling what came of each; return the exit status.

    Raises:
        BadInputError: the folder of a run holds a training with other overrides.
    """

    def finished(run: Run) -> None:
        if (row := run.row()) is not None:
            verdict = "learned" if row.learned else "not learned"
            console.note(f"{run.name}: {verdict}, success {row.success_rate:.0%}, {row.oracle_queries} questions")

    return measured_runs.measure("Ablations", runs, finished, launch, minutes, jobs)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure what the arguments name, and write all that is measured so far."""
    names, cases = [variant.name for variant in VARIANTS], [case.name for case in CASES]
    parser = argparse.ArgumentParser(description="Measure what each deviation from the paper adds, by undoing it.")
    parser.add_argument("--cases", nargs="+", choices=cases, default=cases, help="default: all")
    parser.add_argument("--variants", nargs="+", choices=names, default=names, metavar="NAME", help="default: all")
    parser.add_argument("--seeds", nargs="+", type=int, choices=SEEDS, default=list(SEEDS), help="default: all")
    parser.add_argument("--people", type=Path, default=PEOPLE, help="folder of people's motions; default: %(default)s")
    parser.add_argument("--minutes", type=float, help="begin no new run after that time; default: no limit")
    add_jobs(parser)
    given = parser.parse_args(arguments)
    chosen = [variant for variant in VARIANTS if variant.name in given.variants]

    def work() -> int:
        os.chdir(Path(__file__).resolve().parents[1])
        found = cases_found([case for case in CASES if case.name in given.cases], given.people)
        try:
            return measure(runs_of(found, chosen, given.seeds, given.people), minutes=given.minutes, jobs=given.jobs)
        finally:
            write_results(given.people)

    return guard(work, debug=False)


if __name__ == "__main__":
    sys.exit(main())
