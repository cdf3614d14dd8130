"""An experiment: a YAML file that says what is trained, how it is measured, with which seeds, and which tables show it.

Overrides may hold ``{seed}`` and ``{folder}``, the seed and the folder of a run. Where the experiment, a case and a
variant give the same key, the variant's value counts.
"""

from pathlib import Path
from typing import Any, Final, Literal, Self

from pydantic import Field, model_validator

from koopdqn.errors import unknown_name
from koopdqn.settings import Count, Name, Names, Settings, validate

FOLDER: Final = Path(__file__).with_name("experiments")
"""Where the experiments of the Makefile are."""

Kind = Literal["whole", "percent", "tenths", "millimetres"]
"""How a number is shown: rounded, a share in percent, with one decimal, metres in millimetres."""
Show = Literal[
    "mean", "median", "least", "mean (least)", "mean (least to most)", "median (most)", "median (mean)", "true of all"
]
"""How a cell shows the values of several seeds; what stands in brackets is left out where it says nothing new."""


class Case(Settings):
    """What is learned: overrides of the training, and a file of demonstrations below the data folder, if any."""

    train: Names = ()
    file: str = ""


class Variant(Settings):
    """How it is learned and measured.

    Attributes:
        about: in a few words what it is; "" to show its overrides instead.
        train: overrides of the training.
        of: the variant whose training is measured or learned from, if it has none of its own.
        by: the command that measures, or the method that learns from that training's demonstrations (imitate.py).
        measure: overrides of that.
        baselines: what is shown below it of that which learns nothing: keys of ``eval.json`` and what they are.
        cases: in which it is measured; empty for all.
        seeds: with which; empty for those of the experiment.
        undoes: numbers of the deviations of docs/algorithm.md that it undoes, wholly or in part.
        own_demonstrations: whether it learns from other demonstrations than the other variants.
        kept: the values of each of its runs by case, if it is not measured here.
    """

    about: str = ""
    train: Names = ()
    of: str = ""
    by: Literal[
        "eval", "fit", "cloning", "cloning-noise", "hg-dagger", "sqil", "dmp", "promp", "sb3-dqn", "sb3-ppo", "sb3-sac"
    ] = "eval"
    measure: Names = ()
    baselines: dict[str, str] = Field(default_factory=dict)
    cases: Names = ()
    seeds: list[int] = Field(default_factory=list)
    undoes: list[int] = Field(default_factory=list)
    own_demonstrations: bool = False
    kept: dict[str, list[dict[str, Any]]] = Field(default_factory=dict)


class Column(Settings):
    """A column of a table: which value, how its numbers look, how several seeds are put together, what is better."""

    value: Name
    kind: Kind = "whole"
    show: Show = "mean"
    better: Literal["", "more", "less"] = ""


class Table(Settings):
    """A table: a row for every case and line, or for every comparison.

    Attributes:
        title: what stands above it; if it holds ``{case}``, there is a table for each case.
        labels: headings of the first columns and what they say.
        columns: headings of the others and their values.
        beside: the variant whose values all others are shown less; "" for none.
        comparisons: pairs of lines, by what the first one's values less the second one's answer.
    """

    title: str = ""
    labels: dict[str, Literal["case", "about", "config", "undoes", "seeds"]]
    columns: dict[str, Column]
    beside: str = ""
    comparisons: dict[str, list[str]] = Field(default_factory=dict)


class Experiment(Settings):
    """An experiment.

    Attributes:
        page: the page with the tables, below the repository's root.
        folder: of the runs, below the root; "" to measure everything anew in a folder that is not kept.
        results: JSON file below the root that keeps what runs came to where their folders do not, as on another
            machine; "" for none. What it holds with the settings that are asked for is not measured again.
        jobs: how many runs are made side by side unless it is said.
        people: whether the cases are the sets of people's motions below the data folder, each demonstration held out.
        seeds: of the trainings.
        train: overrides of all trainings.
        measure: overrides of all that measures.
        cases: by name.
        variants: by name, in their order.
        values: what is kept of a run, by name: a key, with dots, of ``train``, ``eval`` or ``fit`` (the file of that
            name) or of ``result`` (what :mod:`people_sets` adds); of several with "or" the first known.
        tables: by the page's part that they are written to.
        printed: what commands print on standard output, by the page's part.
        machine: the page's part that says what was measured on; "" for none.
        pictures: files below the root, and the files of runs that they are copies of.
    """

    page: Name
    folder: str = ""
    results: str = ""
    jobs: Count = 2
    people: bool = False
    seeds: list[int] = Field(default_factory=list)
    train: Names = ()
    measure: Names = ()
    cases: dict[str, Case] = Field(default_factory=dict)
    variants: dict[str, Variant]
    values: dict[str, str]
    tables: dict[str, list[Table]]
    printed: dict[str, list[list[str]]] = Field(default_factory=dict)
    machine: str = ""
    pictures: dict[str, str] = Field(default_factory=dict)

    @property
    def lines(self) -> dict[str, str]:
        """What every line of a table is, by its name: a variant, or ``VARIANT/BASELINE``."""
        found = {}
        for name, variant in self.variants.items():
            found[name] = variant.about or self.config(*variant.train, *variant.measure)
            found |= {f"{name}/{key}": about for key, about in variant.baselines.items()}
        return found

    def config(self, *overrides: str) -> str:
        """Return overrides in Markdown, less those of keys that the whole experiment sets."""
        common = {item.partition("=")[0] for item in (*self.train, *self.measure)}
        return " ".join(f"`{item}`" for item in overrides if item.partition("=")[0] not in common)

    @model_validator(mode="after")
    def _check_names(self) -> Self:
        variants, tables = self.variants.values(), [table for each in self.tables.values() for table in each]
        for what, names, known in (
            (
                "variant",
                [each.of for each in variants if each.of] + [t.beside for t in tables if t.beside],
                self.variants,
            ),
            ("case", [name for each in variants for name in (*each.cases, *each.kept)], self.cases),
            ("value", [column.value for table in tables for column in table.columns.values()], self.values),
            ("line", [name for table in tables for pair in table.comparisons.values() for name in pair], self.lines),
        ):
            for name in names:
                if name not in known:
                    raise unknown_name(what, name, known)
        return self


def load(name: str) -> Experiment:
    """Return the experiment of that name, or of that YAML file.

    Raises:
        BadInputError: there is none, or it breaks a rule.
    """
    from omegaconf import OmegaConf

    path = Path(name) if name.endswith(".yaml") else FOLDER / f"{name}.yaml"
    if not path.is_file():
        raise unknown_name("experiment", name, [each.stem for each in FOLDER.glob("*.yaml")])
    content = OmegaConf.to_container(OmegaConf.load(path))
    return validate(content if isinstance(content, dict) else {}, Experiment, path.name)


def merged(*overrides: Names) -> tuple[str, ...]:
    """Return overrides in their order, of those of one key the last."""
    return tuple({item.partition("=")[0]: item for items in overrides for item in items}.values())
