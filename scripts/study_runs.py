"""The runs of an experiment: a training and what measures it, each made in a folder of its own, and what they came to.

What is finished is not made again, and an interrupted training goes on from its checkpoint. What was made with other
settings than are asked for now is set aside, and made anew. Folders may have moved since they were made.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Self

import people_sets
from experiment import Case, Experiment, Variant, merged

from koopdqn import console
from koopdqn.app.hydra.overrides import prepare
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.demonstrations.hdf5 import read_hdf5, write_hdf5
from koopdqn.errors import BadInputError
from koopdqn.files import read_json

Launch = Callable[[str, Sequence[str], Path], int]
"""Carries out a command: its name, its arguments, the file for its output; gives its exit status."""

IMITATE: Final = "imitate"
"""The one command that is a script of this folder and none of koopdqn's."""

_RECORD: Final = Path(".hydra") / "overrides.yaml"
_PLACES: Final = ("command", "out", "run")


@dataclass(frozen=True)
class Step:
    """A command (koopdqn's or :data:`IMITATE`), its arguments beside the folder, and the folder that it fills."""

    command: str
    arguments: tuple[str, ...]
    folder: Path

    @property
    def report(self) -> Path:
        """The file that is there when all is made."""
        return self.folder / ("eval.json" if self.command == IMITATE else f"{self.command}.json")

    def other_settings(self) -> bool:
        """Return whether the folder records other settings, wherever run folders and data lie."""
        from omegaconf import OmegaConf

        record, imitated = self.folder / _RECORD, self.folder / "imitation.json"
        if self.command == IMITATE and imitated.is_file():
            # Earlier ones lack their settings.
            recorded = read_json(imitated, "the imitation report").get("settings", self.arguments)
            return _settings(self.arguments) != _settings(recorded)
        if not record.is_file():
            return False
        return _settings(prepare(self.command, self.arguments).overrides) != _settings(map(str, OmegaConf.load(record)))

    def finished(self) -> bool:
        """Return whether it came to a result with these settings."""
        return self.report.is_file() and not self.other_settings()

    def carry_out(self, launch: Launch) -> tuple[int, str]:
        """Do what is left; return the exit status, and "" or that the command crashed."""
        if self.finished():
            return 0, ""
        arguments = [*self.arguments, f"out={self.folder}"]
        if self.command == "train" and (self.folder / _RECORD).is_file() and not self.other_settings():
            arguments = [f"run={self.folder}"]
        elif self.folder.is_dir() and any(self.folder.iterdir()):
            set_aside(self.folder)
        output = self.folder.parent / f"{self.command}.txt"
        status = launch(self.command, arguments, output)
        # A training that did not learn ends with 1 too, but with its report.
        if status == 0 or (self.command == "train" and status == 1 and self.report.is_file()):
            return status, ""
        return status, f"{self.command} ended with exit status {status}, see {console.shown_path(output)}"


def _settings(overrides: Iterable[str]) -> dict[str, str]:
    given = {name: value for name, _, value in (item.partition("=") for item in overrides) if name not in _PLACES}
    return {name: Path(value).name.strip("'\"") if name == "demos" else value for name, value in given.items()}


def set_aside(folder: Path) -> None:
    """Rename a folder so that another takes its place; nothing is removed."""
    number = 1
    while (former := folder.with_name(f"{folder.name}.former-{number}")).exists():
        number += 1
    folder.rename(former)
    console.note(f"{console.shown_path(folder)} is made anew; what it held is now in {former.name}")


@dataclass(frozen=True)
class Result:
    """What one line of a run came to.

    Attributes:
        case: name of the case.
        line: name of the variant, or ``VARIANT/BASELINE``.
        seed: of the run; None of a kept result.
        values: by name; None where a value is not known or not defined.
        settings: overrides of what it was made with, by command and name; none of a kept result.
    """

    case: str
    line: str
    seed: int | None
    values: dict[str, Any]
    settings: dict[str, dict[str, str]] = field(default_factory=dict)

    def row(self) -> dict[str, Any]:
        """Return it as a row of a file of results."""
        return {"case": self.case, "variant": self.line, "seed": self.seed, "settings": self.settings, **self.values}

    @classmethod
    def of_row(cls, row: Mapping[str, Any]) -> Self:
        """Return what :meth:`row` returned.

        Raises:
            AttributeError, KeyError, TypeError: it is none.
        """
        known = ("case", "variant", "seed", "settings")
        values = {name: value for name, value in row.items() if name not in known}
        return cls(row["case"], row["variant"], row["seed"], values, row["settings"])


@dataclass(frozen=True)
class Run:
    """A variant with a seed in a case.

    Attributes:
        experiment: what it is part of.
        case: name of the case.
        variant: name of the variant.
        seed: of the training; of people's motions the number of the demonstration held out.
        root: folder of all runs.
        data: folder of demonstrations of people.
        people: the demonstrations, if the case is a set of people's.
    """

    experiment: Experiment
    case: str
    variant: str
    seed: int
    root: Path
    data: Path
    people: tuple[Demonstration, ...] = ()

    @property
    def name(self) -> str:
        """What the run is called in messages."""
        return f"{self.case} held out {self.seed}" if self.people else f"{self.case} {self.variant} seed {self.seed}"

    @property
    def chain(self) -> tuple[str, str, int]:
        """What it has in common with the runs that share its training."""
        return self.case, self._owner, self.seed

    @property
    def folder(self) -> Path:
        """The folder that holds all of it, but a training that it shares."""
        return self._folder_of(self.variant)

    @property
    def trainings(self) -> tuple[Step, ...]:
        """The training; of people's motions also the same on demonstrations that are moved to where the arm can go."""
        folder, variant = self._folder_of(self._owner), self.experiment.variants[self._owner]
        file = (f"demos={self.data / self._case.file}",) if self._case.file else ()
        given = merged(self._case.train, file, self.experiment.train, variant.train)
        overrides = tuple(item.format(seed=self.seed, folder=folder) for item in given)
        if not self.people:
            return (Step("train", overrides, folder / "train"),)
        moved = (*overrides, "demos.place=auto")
        return Step("train", overrides, folder / "run"), Step("train", moved, folder / "placed")

    @property
    def training(self) -> Step:
        """The training that is measured, or whose demonstrations are learned from."""
        return next((step for step in self.trainings if step.finished()), self.trainings[0])

    @property
    def measurement(self) -> Step:
        """What measures the training, or learns from its demonstrations and measures that."""
        by, training = self._variant.by, self.training.folder
        given = merged(self.experiment.measure, self._variant.measure)
        given = tuple(item.format(seed=self.seed, folder=self.folder) for item in given)
        if by == "fit":
            return Step(by, (*self._case.train, *given, f"demos={training / 'demos.hdf5'}"), self.folder / by)
        command, method = (by, ()) if by == "eval" else (IMITATE, (f"method={by}",))
        return Step(command, (*method, f"run={training}", *given), self.folder / "eval")

    @property
    def settings(self) -> dict[str, dict[str, str]]:
        """The overrides that it is made with, by command and name, wherever folders and data lie; and whose motions."""
        steps = {"train": self.trainings[0], self.measurement.command: self.measurement}
        given = {command: _settings(step.arguments) for command, step in steps.items()}
        return given | ({"set": {"digest": self._digest}} if self.people else {})

    @property
    def baselines(self) -> tuple[str, ...]:
        """The names of what is shown below it."""
        return tuple(self._variant.baselines)

    def finished(self) -> bool:
        """Return whether all of it came to a result."""
        return self.training.finished() and self.measurement.finished() and not self._of_other_motions()

    def carry_out(self, launch: Launch) -> str:
        """Do what is left; return "" or, if a command crashed, one line that says so."""
        if any(step.other_settings() for step in self.trainings):
            sharing = [name for name, each in self.experiment.variants.items() if (each.of or name) == self._owner]
            for folder in map(self._folder_of, sharing):
                if folder.is_dir():
                    set_aside(folder)
        if self.people:
            if self._of_other_motions():
                set_aside(self.folder)
            shown = self.folder / "shown.hdf5"
            if not shown.is_file():
                shown.parent.mkdir(parents=True, exist_ok=True)
                write_hdf5(shown, people_sets.arranged(self.people, self.seed))
        crash = ""
        for step in () if self.training.finished() else self.trainings:
            status, crash = step.carry_out(launch)
            if status != BadInputError.exit_status:
                break
        if not crash:
            _, crash = self.measurement.carry_out(launch)
        return crash and f"{self.name}: {crash}"

    def results(self) -> list[Result]:
        """Return what it and the baselines below it came to; nothing if it is not finished.

        Where an experiment keeps whether runs are finished, one that was begun alone has that as its result.
        """
        if not self.finished():
            begun = "finished" in self.experiment.values and self.folder.is_dir()
            return [self._result("", {"finished": False})] if begun else []
        measured = read_json(self.measurement.report, "the report")
        record = {"finished": True, "fit" if self._variant.by == "fit" else "eval": measured}
        if self._variant.by == "fit":
            measured["reached_share"] = measured["roll_out_error_m"]["reached_goal"] / measured["demonstrations"]
        elif self._variant.by == "eval":
            record["train"] = read_json(self.training.report, "the training report")
            record["train"]["least_check"] = least_check(record["train"])
        else:
            record["train"] = read_json(self.measurement.folder / "imitation.json", "the imitation report")
        if self.people:
            record["result"] = people_sets.beside(self.folder, self.training.folder)
        below = [self._result(f"/{name}", {"eval": measured["baselines"][name]}) for name in self.baselines]
        return [self._result("", record), *below]

    def _result(self, below: str, record: Mapping[str, Any]) -> Result:
        values = {name: _known(record, paths) for name, paths in self.experiment.values.items()}
        return Result(self.case, f"{self.variant}{below}", self.seed, values, self.settings)

    @cached_property
    def _digest(self) -> str:
        return people_sets.arranged(self.people, self.seed).digest()

    def _of_other_motions(self) -> bool:
        """Return whether the folder is of a set that has changed since."""
        shown = self.folder / "shown.hdf5"
        return bool(self.people) and shown.is_file() and read_hdf5(shown).digest() != self._digest

    @property
    def _case(self) -> Case:
        return Case() if self.people else self.experiment.cases[self.case]

    @property
    def _variant(self) -> Variant:
        return self.experiment.variants[self.variant]

    @property
    def _owner(self) -> str:
        return self._variant.of or self.variant

    def _folder_of(self, variant: str) -> Path:
        place = f"held-out-{self.seed}" if self.people else f"{variant}/{self.seed}"
        return self.root / self.case / place


def least_check(report: Mapping[str, Any]) -> float | None:
    """Return the least success rate of the checks after the one by which ``train.json`` calls it learned."""
    since = report["learned_at_env_steps"]
    after = [check["success_rate"] for check in report["checks"] if since is not None and check["env_steps"] > since]
    return min(after, default=None)


def _known(record: Mapping[str, Any], paths: str) -> Any:
    """Return the first value that is known of dotted paths with "or" between them, or None."""
    for path in paths.split(" or "):
        node: Any = record
        for part in path.split("."):
            node = node[int(part)] if isinstance(node, list) else (node or {}).get(part)
        if node is not None:
            return node
    return None
