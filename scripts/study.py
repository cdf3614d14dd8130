"""Measures the default preset beside what is simpler, older or more laborious: `make study`.

Every line of the table is trained and evaluated with its seeds, in runs/study/TASK/LINE/SEED/{train,eval}; what is
finished there is not done again, and an interrupted training goes on from its checkpoint. With the same task and seed
every line learns from the same demonstrations and is measured from the same starts. The results go to
runs/study/study.json, one for each run, and after every run as tables to docs/study.md.

A training that does not learn is a result like any other. Exit status 0 if every run begun came to a result, 1 if a
command crashed (its output lies beside the run; the other runs are still made), 2 bad input.
"""

import argparse
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import measured_runs
from imitate import IMITATION
from measured_runs import Command, Launch, Training, add_jobs
from study_lines import EVALUATION_SEED, LINES, SEEDS, TASKS, Line
from study_tables import PaperRun, Result, least_check, with_tables

from koopdqn import console
from koopdqn.app.exit_status import guard
from koopdqn.errors import BadInputError
from koopdqn.files import read_json, write_json, write_text
from koopdqn.settings import validate

FOLDER: Final = Path("runs") / "study"
PAGE: Final = Path("docs") / "study.md"
PAPER_RUNS: Final = Path("docs") / "paper_runs.json"

_IMITATE: Final = "imitate"
_NONE: Final = {"trusted": None, "remembered": None}


@dataclass(frozen=True)
class Run:
    """A line with a seed on a task, and where its results lie.

    Attributes:
        task: name of the task.
        line: what is measured.
        seed: of demonstrations and training.
        root: folder of the runs.
    """

    task: str
    line: Line
    seed: int
    root: Path = FOLDER

    @property
    def name(self) -> str:
        """What the run is called in messages."""
        return f"{self.task} {self.line.name} seed {self.seed}"

    @property
    def folder(self) -> Path:
        """The folder that holds the run's evaluation, and its training if it has its own."""
        return self.root / self.task / self.line.name / str(self.seed)

    @property
    def training(self) -> Training:
        """The training that is measured, or whose demonstrations are learned from."""
        folder = self.root / self.task / (self.line.of or self.line.name) / str(self.seed)
        return Training(folder / "train", (f"task={self.task}", *self.line.overrides, f"seed={self.seed}"), folder)

    def commands(self) -> list[Command]:
        """Return what is left to do: names and arguments of the commands, none if the run is finished.

        Raises:
            BadInputError: the folder holds a training with other overrides.
        """
        left, measured = self.training.commands(), self.folder / "eval"
        if not left and (measured / "eval.json").is_file():
            return []
        inputs, starts = [f"run={self.training.folder}", f"out={measured}"], f"eval.seed={EVALUATION_SEED}"
        if self.line.method:
            return [*left, (_IMITATE, [self.line.method, *inputs, starts])]
        beside = f"eval.baselines={str(bool(self.line.baselines)).lower()}"
        return [*left, ("eval", [*inputs, "eval.dynamics=false", starts, beside, *self.line.evaluation])]

    def results(self) -> list[Result]:
        """Return the line's result and those of the baselines below it; none if the run is not finished.

        Raises:
            BadInputError: the folder holds a training with other overrides, or an evaluation without those baselines.
        """
        if self.commands():
            return []
        evaluation = read_json(self.folder / "eval" / "eval.json", "the evaluation report")
        if self.line.method:
            about = read_json(self.folder / "eval" / IMITATION, "the imitation report")
            trained = {**about, "learned": None, "reward_agreement": _NONE}
            return [self._result(self.line.name, evaluation, trained, None)]
        trained = read_json(self.training.folder / "train.json", "the training report")
        results = [self._result(self.line.name, evaluation, trained, least_check(trained))]
        nothing = {**trained, "learned": None, "oracle_queries": 0, "reward_agreement": _NONE, "seconds": None}
        for name in self.line.baselines:
            measured = (evaluation["baselines"] or {}).get(name)
            if measured is None:
                raise BadInputError(
                    f"{self.folder / 'eval' / 'eval.json'}: must hold the baseline {name}, found none;"
                    " remove the folder to measure it again"
                )
            results.append(self._result(self.line.named(name), measured, nothing, None))
        return results

    def _result(
        self, line: str, measured: Mapping[str, Any], trained: Mapping[str, Any], least: float | None
    ) -> Result:
        return Result(
            task=self.task,
            line=line,
            seed=self.seed,
            learned=trained["learned"],
            success_rate=measured["success_rate"],
            path_deviation_mm=measured["path_deviation_mm"]["mean"],
            p95_of_max_mm=measured["path_deviation_mm"]["p95_of_max"],
            rotation_deviation_deg=measured["rotation_deviation_deg"]["mean"],
            questions=trained["oracle_queries"],
            trusted=trained["reward_agreement"]["trusted"],
            remembered=trained["reward_agreement"]["remembered"],
            least_check=least,
            seconds=trained["seconds"],
            failures={cause: count for cause, count in measured["failures"].items() if count},
            demonstrations=trained["made_from"]["demonstrations"],
        )


def launch(command: str, arguments: Sequence[str], output: Path) -> int:
    """Carry out a koopdqn command, or ``imitate.py``, in a process of its own."""
    if command != _IMITATE:
        return measured_runs.launch(command, arguments, output)
    return measured_runs.call([str(Path(__file__).with_name("imitate.py")), *arguments], output)


def runs_of(tasks: Sequence[str], lines: Iterable[Line], seeds: Sequence[int], root: Path = FOLDER) -> list[Run]:
    """Return the runs in their order: everything with one seed, then the next, so that an early end is fair."""
    lines = list(lines)
    return [
        Run(task, line, seed, root)
        for seed in seeds
        for task in tasks
        for line in lines
        if seed in line.seeds and task in line.tasks
    ]


def write_results(root: Path = FOLDER, page: Path = PAGE, paper: Path = PAPER_RUNS) -> list[Result]:
    """Write study.json and the page's tables from every finished run; return the results.

    Raises:
        BadInputError: the page or the kept results of the paper preset cannot be read, a run was made with other
            overrides, or runs of one seed learned from different demonstrations.
    """
    results = [result for task in TASKS for run in runs_of([task], LINES, SEEDS, root) for result in run.results()]
    anew = {name for line in LINES if line.shown_anew for name in (line.name, *map(line.named, line.baselines))}
    _check_demonstrations((result for result in results if result.line not in anew), root)
    write_json(root / "study.json", [asdict(result) for result in results])
    try:
        text = page.read_text(encoding="utf-8")
    except OSError as error:
        raise BadInputError(f"{page} must be readable, the system says: {error.strerror}") from error
    write_text(page, with_tables(text, results, _paper_runs(paper)))
    return results


def _check_demonstrations(results: Iterable[Result], root: Path) -> None:
    learned_from: dict[tuple[str, int], Result] = {}
    for result in results:
        first = learned_from.setdefault((result.task, result.seed), result)
        if first.demonstrations != result.demonstrations:
            raise BadInputError(
                f"{root / result.task}: all lines must learn from the same demonstrations with seed {result.seed},"
                f" found {first.line} and {result.line} to differ; remove one of them to measure it anew"
            )


def _paper_runs(path: Path) -> dict[str, PaperRun]:
    if not path.exists():
        return {}
    kept = read_json(path, "the kept results of the paper preset")
    return {task: validate(kept[task], PaperRun, f"{path}: {task}") for task in TASKS if task in kept}


def measure(
    runs: Sequence[Run],
    launch: Launch = launch,
    minutes: float | None = None,
    root: Path = FOLDER,
    page: Path = PAGE,
    paper: Path = PAPER_RUNS,
    jobs: int = 1,
) -> int:
    """Carry out what is left of the runs, writing the tables after each; return the exit status.

    Raises:
        BadInputError: the folder of a run holds a training with other overrides, or see :func:`write_results`.
    """

    def finished(run: Run) -> None:
        write_results(root, page, paper)
        for result in run.results():
            console.note(f"{run.task} {result.line} seed {run.seed}: success {result.success_rate:.0%}")

    # Lines of one task and seed share a training, and the demonstrations that it made.
    return measured_runs.measure(
        "Study", runs, finished, launch, minutes, jobs, together=lambda run: (run.task, run.seed)
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure what the arguments name, and write all that is measured so far."""
    names = [line.name for line in LINES]
    parser = argparse.ArgumentParser(description="Measure the default preset beside what it stands against.")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS), help="default: all")
    parser.add_argument("--rows", nargs="+", choices=names, default=names, metavar="NAME", help="default: all")
    parser.add_argument("--seeds", nargs="+", type=int, choices=SEEDS, default=list(SEEDS), help="default: all")
    parser.add_argument("--minutes", type=float, help="begin no new run after that time; default: no limit")
    add_jobs(parser)
    given = parser.parse_args(arguments)
    chosen = [line for line in LINES if line.name in given.rows]

    def work() -> int:
        os.chdir(Path(__file__).resolve().parents[1])
        write_results()  # a page that cannot be written is found out before hours are spent
        return measure(runs_of(given.tasks, chosen, given.seeds), minutes=given.minutes, jobs=given.jobs)

    return guard(work, debug=False)


if __name__ == "__main__":
    sys.exit(main())
