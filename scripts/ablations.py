"""Measures what the method's ideas add, by leaving out one at a time: `make ablations`.

Every variant of the config is trained and evaluated with every seed, in runs/ablations/TASK/VARIANT/SEED/{train,eval};
what is finished there is not done again, and an interrupted training goes on from its checkpoint. The results go to
runs/ablations/ablations.json, one row a run, and as tables to docs/ablations.md.

A training that does not learn within its limit is a result like any other. Exit status 0 if every run came to a
result, 1 if a command crashed (its output lies beside the run; the other runs are still made), 2 bad input.
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from ablation_tables import Row, with_tables
from ablation_variants import VARIANTS, Variant
from omegaconf import OmegaConf

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

    def commands(self) -> list[tuple[str, list[str]]]:
        """Return what is left to do: names and arguments of the koopdqn commands, none if the run is finished.

        Raises:
            BadInputError: the folder holds a training with other overrides.
        """
        train, measured = self.folder / "train", self.folder / "eval"
        if (measured / "eval.json").is_file() and self._trained():
            return []
        left = []
        if not self._trained():
            begun = self._recorded() is not None
            left.append(("train", [f"run={train}"] if begun else [*self.overrides, f"out={train}"]))
        left.append(("eval", [f"run={train}", f"out={measured}", *EVALUATION]))
        return left

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

    def _trained(self) -> bool:
        recorded = self._recorded()
        if recorded is not None and sorted(recorded) != sorted(self.overrides):
            raise BadInputError(
                f"{self.folder / 'train'}: must be a training with {' '.join(self.overrides)}, found one with"
                f" {' '.join(recorded)}; remove {self.folder} to measure anew"
            )
        return recorded is not None and (self.folder / "train" / "train.json").is_file()

    def _recorded(self) -> list[str] | None:
        path = self.folder / "train" / ".hydra" / "overrides.yaml"
        if not path.is_file():
            return None
        recorded = [str(item) for item in OmegaConf.load(path)]
        return [item for item in recorded if item.partition("=")[0] not in ("command", "out")]


Launch = Callable[[str, Sequence[str], Path], int]
"""Carries out a koopdqn command: its name, its arguments, the file for its output; gives its exit status."""


def launch(command: str, arguments: Sequence[str], output: Path) -> int:
    """Carry out a koopdqn command in a process of its own, so that its end is not ours."""
    output.parent.mkdir(parents=True, exist_ok=True)
    with output.open("a", encoding="utf-8") as file:
        call = [sys.executable, "-m", "koopdqn", command, *arguments]
        return subprocess.run(call, stdin=subprocess.DEVNULL, stdout=file, stderr=file).returncode


def carry_out(run: Run, launch: Launch = launch) -> str:
    """Do what is left of a run; return "" or, if a command crashed, one line that says so.

    Raises:
        BadInputError: the folder holds a training with other overrides.
    """
    for command, arguments in run.commands():
        output = run.folder / f"{command}.txt"
        status = launch(command, arguments, output)
        # A training that did not learn ends with 1 too, but with its report.
        if status != 0 and not (command == "train" and status == 1 and (run.folder / "train" / "train.json").is_file()):
            return f"{run.name}: koopdqn {command} ended with exit status {status}, see {output}"
    return ""


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


def measure(runs: Sequence[Run], launch: Launch = launch) -> int:
    """Carry out what is left of the runs and write the results; return the exit status.

    Raises:
        BadInputError: the folder of a run holds a training with other overrides.
    """
    for run in runs:
        run.commands()  # other overrides are found out before hours are spent
    crashes = []
    with console.stage("Ablations", len(runs)) as stage:
        for run in runs:
            stage.advance(0, run.name)
            crash = carry_out(run, launch)
            if crash:
                crashes.append(crash)
                console.warn(crash)
            elif (row := run.row()) is not None:
                verdict = "learned" if row.learned else "not learned"
                console.note(f"{run.name}: {verdict}, success {row.success_rate:.0%}, {row.oracle_queries} questions")
            stage.advance(1)
    return 1 if crashes else 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure what the arguments name, and write all that is measured so far."""
    names = [variant.name for variant in VARIANTS]
    parser = argparse.ArgumentParser(description="Measure what the method's ideas add, by leaving out one at a time.")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=["shelf"], help="default: shelf")
    parser.add_argument("--variants", nargs="+", choices=names, default=names, metavar="NAME", help="default: all")
    parser.add_argument("--seeds", nargs="+", type=int, choices=SEEDS, default=list(SEEDS), help="default: all")
    given = parser.parse_args(arguments)
    chosen = [variant for variant in VARIANTS if variant.name in given.variants]

    def work() -> int:
        os.chdir(Path(__file__).resolve().parents[1])
        try:
            return measure(runs_of(given.tasks, chosen, given.seeds))
        finally:
            write_results()

    return guard(work, debug=False)


if __name__ == "__main__":
    sys.exit(main())
