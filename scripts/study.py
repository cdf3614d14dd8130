"""Makes the runs of an experiment and writes its tables: `make study`, `make ablations`, `make people`, `make figures`.

    python scripts/study.py ablations --cases shelf --variants default sign --seeds 0

An experiment is a YAML file of scripts/experiments, or one of your own (scripts/experiment.py says what it holds).
What is finished in its folder, or stands with the same settings in its file of results, is not made again, and an
interrupted training goes on from its checkpoint. The results go to that JSON file, and after every run as tables to the
experiment's page. All is made with one seed before the next, so that an early end is fair. A training that does not
learn is a result like any other.

Exit status 0 if every run begun came to a result, 1 if a command crashed (its output lies beside the run; the other
runs are still made), 2 bad input.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

import people_sets
import side_by_side
from experiment import Experiment, load
from study_runs import Launch, Result, Run
from study_tables import with_tables

from docs import replaced
from koopdqn import console
from koopdqn.app.exit_status import guard
from koopdqn.errors import BadInputError, WorkFailedError, unknown_name
from koopdqn.files import canonical_json, read_json, write_text

ROOT: Final = Path(__file__).resolve().parents[1]
DATA: Final = Path("..") / "shared" / "data"
"""Where motions of people are by default."""


class Study:
    """An experiment, its runs and its results.

    Attributes:
        runs: all of them, in their order.
    """

    def __init__(self, name: str, experiment: Experiment, root: Path, data: Path = DATA) -> None:
        """Find the runs; a set of people's motions that is not there is left out, which is said.

        Args:
            name: of the experiment, and of the file of its results.
            experiment: what it is.
            root: folder of the runs.
            data: folder of demonstrations of people.

        Raises:
            BadInputError: an experiment of people's motions finds none, or its results cannot be read.
        """
        self._name, self._experiment, self._root = name, experiment, root
        self._page = ROOT / experiment.page
        self._kept = ROOT / experiment.results if experiment.results else root / f"{name}.json"
        people = people_sets.sets_below(data) if experiment.people else {}
        if experiment.people and not people:
            raise BadInputError(
                f"--data: must hold sets of at least {people_sets.LEAST} demonstrations, found none below {data}"
            )
        seeds = {case: list(range(len(items))) for case, items in people.items()}
        for case, content in experiment.cases.items():
            if not content.file or (data / content.file).is_file():
                seeds[case] = experiment.seeds
            else:
                console.note(f"{case} is left out: {data / content.file} does not exist")
        self._cases = list(seeds)
        self.runs = [
            Run(experiment, case, variant, seed, root, data, people.get(case, ()))
            for seed in sorted({seed for each in seeds.values() for seed in each})
            for variant, content in experiment.variants.items()
            for case in content.cases or seeds
            if case in seeds and seed in (content.seeds or seeds[case]) and not content.kept
        ]
        rows = self._stored()
        self._known = self._earlier(rows)
        # What was measured of motions that are not here stays as it is.
        self._elsewhere = [
            row for row in rows if row.case not in seeds and row.seed is not None and row.line in experiment.lines
        ]
        self._cases += dict.fromkeys(row.case for row in self._elsewhere)

    def chosen(self, **wanted: Sequence[str | int]) -> list[Run]:
        """Return the runs whose ``case``, ``variant`` and ``seed`` are wanted; an empty list is every one.

        Raises:
            BadInputError: a name is not known.
        """
        runs = self.runs
        for what, names in wanted.items():
            known = {str(getattr(run, what)) for run in self.runs}
            for name in map(str, names):
                if name not in known:
                    raise unknown_name(what, name, known)
            runs = [run for run in runs if not names or getattr(run, what) in names]
        return runs

    def results(self) -> list[Result]:
        """Return the results of every finished run, and those that are kept, case by case.

        Raises:
            BadInputError: a result cannot be read, or runs of one seed learned from different demonstrations.
        """
        variants, found = self._experiment.variants, []
        for run in self.runs:
            found += self._results_of(run)
        found += self._elsewhere
        for name, variant in variants.items():
            for case in variant.kept.keys() & {each.case for each in found}:
                for kept in variant.kept[case]:
                    found.append(Result(case, name, None, {**dict.fromkeys(self._experiment.values), **kept}))
        first: dict[tuple[str, int | None], Result] = {}
        for each in found:
            shown = each.values.get("demonstrations")
            if shown is None or variants[each.line.partition("/")[0]].own_demonstrations:
                continue
            other = first.setdefault((each.case, each.seed), each)
            if other.values["demonstrations"] != shown:
                raise BadInputError(
                    f"{self._root / each.case}: all must learn from the same demonstrations with seed {each.seed},"
                    f" found {other.line} and {each.line} to differ; remove one of them to measure it anew"
                )
        return sorted(found, key=lambda each: self._cases.index(each.case))

    def write(self) -> None:
        """Write the results and the page's tables.

        Raises:
            BadInputError: the page cannot be read or lacks a part, or see :meth:`results`.
        """
        results = self.results()
        # A line a result, so that what is measured anew can be seen beside what was.
        rows = ",\n".join(canonical_json(each.row()) for each in results)
        write_text(self._kept, f"[\n{rows}\n]\n")
        write_text(self._page, with_tables(self._text(), self._experiment, results))

    def measure(
        self, runs: Sequence[Run], minutes: float | None = None, jobs: int = 1, launch: Launch = side_by_side.launch
    ) -> int:
        """Carry out what is left of runs, writing results and tables after each; return the exit status.

        Raises:
            BadInputError: see :meth:`write`.
        """

        def finished(run: Run) -> None:
            if self._experiment.folder:
                self.write()
            values = self._results_of(run)[0].values
            said = {"success_rate": "success {:.0%}", "seconds": "{:.0f} s", "oracle_queries": "{} questions"}
            known = [text.format(values[name]) for name, text in said.items() if values.get(name) is not None]
            console.note(f"{run.name}: {', '.join(known) or 'done'}")

        left = [run for run in runs if run.name not in self._known]
        return side_by_side.measure(self._name.capitalize(), left, finished, launch, minutes, jobs)

    def finish(self, machine: str) -> None:
        """Write the tables, and what the page has beside them: what commands print, the machine, the pictures."""
        self.write()
        text = self._text()
        for part, commands in self._experiment.printed.items():
            text = replaced(text, part, printed(commands))
        if self._experiment.machine:
            text = replaced(text, self._experiment.machine, machine)
        write_text(self._page, text)
        for target, source in self._experiment.pictures.items():
            if (self._root / source).is_file():
                shutil.copyfile(self._root / source, ROOT / target)

    def _stored(self) -> list[Result]:
        """Return what stands in the file of results with today's values.

        Raises:
            BadInputError: the file cannot be read.
        """
        if not self._experiment.results or not self._kept.is_file():
            return []
        try:
            rows = [Result.of_row(row) for row in read_json(self._kept, "the results")]
        except (AttributeError, KeyError, TypeError) as error:
            raise BadInputError(f"{self._kept}: must be results of an experiment, found {error!r}") from error
        return [row for row in rows if row.values.keys() == self._experiment.values.keys()]

    def _earlier(self, rows: Sequence[Result]) -> dict[str, list[Result]]:
        """Return, by the runs' names, those of stored results that have today's settings."""
        found: dict[str, list[Result]] = {}
        for run in self.runs:
            ours = {f"{run.variant}{below}" for below in ("", *(f"/{name}" for name in run.baselines))}
            stored = [
                row
                for row in rows
                if (row.case, row.seed) == (run.case, run.seed)
                and row.line in ours
                and row.settings == run.settings
                # One that was begun alone is gone on with.
                and row.values.get("finished") is not False
            ]
            if len(stored) == len(ours):
                found[run.name] = stored
        return found

    def _results_of(self, run: Run) -> list[Result]:
        if run.name not in self._known and run.finished():
            self._known[run.name] = run.results()
        return self._known.get(run.name) or run.results()

    def _text(self) -> str:
        try:
            return self._page.read_text(encoding="utf-8")
        except OSError as error:
            raise BadInputError(f"{self._page} must be readable, the system says: {error.strerror}") from error


def printed(commands: Iterable[Sequence[str]]) -> str:
    """Return, as a block of Markdown, what koopdqn commands print on standard output in a folder of their own.

    Raises:
        WorkFailedError: a command did not end well.
    """
    lines: list[str] = []
    with tempfile.TemporaryDirectory(prefix="koopdqn-") as folder:
        for command in commands:
            call = [sys.executable, "-m", "koopdqn", *command]
            environment = {**os.environ, "COLUMNS": "100", "NO_COLOR": "1"}
            done = subprocess.run(call, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True, check=False)
            if done.returncode:
                raise WorkFailedError(f"koopdqn {' '.join(command)} ended with exit status {done.returncode}")
            lines += [line.rstrip() for line in done.stdout.splitlines() if line.strip()]
    return "\n".join(["```text", *lines, "```"])


def machine() -> str:
    """Return a sentence about what the figures are measured on, and how busy it is before."""
    return f"Measured on {os.cpu_count()} cores; the load average before the first run was {os.getloadavg()[0]:.1f}."


def _jobs(given: str) -> int:
    if not given.isdecimal() or int(given) < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 1, found {given}")
    return int(given)


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the runs that the arguments name, and write all that is measured so far."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("experiment", help="name of a file of scripts/experiments, or a YAML file")
    parser.add_argument("--cases", nargs="+", default=[], metavar="NAME", help="default: all")
    parser.add_argument("--variants", nargs="+", default=[], metavar="NAME", help="default: all")
    parser.add_argument("--seeds", nargs="+", type=int, default=[], help="default: all")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of people's motions; default: %(default)s")
    parser.add_argument("--out", type=Path, help="folder of the runs; default: the experiment's")
    parser.add_argument("--minutes", type=float, help="begin no new run after that time; default: no limit")
    parser.add_argument("--jobs", type=_jobs, help="runs side by side; default: the experiment's")
    given = parser.parse_args(arguments)

    def work() -> int:
        measured_on, experiment = machine(), load(given.experiment)
        with tempfile.TemporaryDirectory(prefix="koopdqn-") as unkept:
            root = given.out or (ROOT / experiment.folder if experiment.folder else Path(unkept))
            study = Study(Path(given.experiment).stem, experiment, root, given.data)
            runs = study.chosen(case=given.cases, variant=given.variants, seed=given.seeds)
            if experiment.folder:
                study.write()  # a page that cannot be written is found out before hours are spent
            status = study.measure(runs, given.minutes, given.jobs or experiment.jobs)
            if status == 0 or experiment.folder:
                study.finish(measured_on)
            return status

    return guard(work, debug=False)


if __name__ == "__main__":
    sys.exit(main())
