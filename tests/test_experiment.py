"""The experiments of the project: valid, and true to docs/algorithm.md."""

import importlib
import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Any, get_args

import pytest
from experiment import FOLDER, Experiment, Variant, load, merged
from experiment_parts import experiment
from imitate import METHODS
from pydantic import BaseModel, ValidationError

from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.hydra.compose import composed
from koopdqn.app.hydra.overrides import prepare
from koopdqn.errors import BadInputError
from koopdqn.evaluation.schema import Baselines, EvaluationFile
from koopdqn.intent.schema import FitReport
from koopdqn.rl.schema import TrainReport

ROOT = Path(__file__).resolve().parents[1]
NAMES = sorted(path.stem for path in FOLDER.glob("*.yaml"))
ABLATIONS = load("ablations")
UNDOING = [name for name in ABLATIONS.variants if name not in ("default", "chance", "chance-again")]
ALGORITHM = (ROOT / "docs" / "algorithm.md").read_text(encoding="utf-8")
DEVIATIONS = ALGORITHM.partition("## Deviations\n")[2].partition("\n### ")[0]


def tree(*overrides: str) -> Any:
    """Return the config tree of a training under overrides, less Hydra's own node."""
    found = composed(prepare("train", [*overrides, "out=unused"]).overrides)
    return {key: found[key] for key in found if key != "hydra"}


@cache
def loaded(*overrides: str) -> tuple[object, ...]:
    found = Configuration.load(tree(*overrides))
    return found.shaped_by(), found.train, found.oracle, found.eval


def leaves(node: Any, prefix: str = "") -> dict[str, Any]:
    """Return the values of a tree by their dotted names."""
    if not isinstance(node, Mapping) and not hasattr(node, "items"):
        return {prefix.removesuffix("."): node}
    found: dict[str, Any] = {}
    for name in node:
        found |= leaves(node[name], f"{prefix}{name}.")
    return found


def trainings() -> list[tuple[str, str, str]]:
    """Return experiment, case and variant of everything that trains or evaluates with settings of its own."""
    return [
        (name, case, variant)
        for name in ("study", "ablations")
        for case in ("shelf", "knife")
        for variant, content in load(name).variants.items()
        if content.by == "eval" and case in (content.cases or ("shelf", "knife"))
    ]


@pytest.mark.parametrize(("name", "case", "variant"), trainings())
def test_every_variant_is_a_valid_config_other_than_the_default(name: str, case: str, variant: str) -> None:
    whole = load(name)
    content = whole.variants[variant]
    seed = tuple(item.format(seed=0) for item in whole.train)
    own = loaded(*merged(whole.cases[case].train, seed, content.train, whole.measure, content.measure))
    default = loaded(*merged(whole.cases[case].train, seed, whole.measure, whole.variants["default"].measure))
    assert (own == default) == (variant == "default")


@pytest.mark.parametrize("name", NAMES)
def test_variants_differ_and_what_shares_a_training_has_none_of_its_own(name: str) -> None:
    variants = load(name).variants
    shown = [each.model_dump_json(exclude={"about"}) for each in variants.values()]
    assert len(set(shown)) == len(shown)
    assert set(METHODS) < set(get_args(Variant.model_fields["by"].annotation))
    for each in variants.values():
        assert not (each.of and each.train)
        assert each.of in ("", "default")
        assert each.of or each.by == "eval"
        assert set(each.baselines) <= set(Baselines.model_fields)
        # A baseline that is shown is measured.
        baselines = merged(load(name).measure, each.measure)
        assert not each.baselines or "eval.baselines=false" not in baselines


def known(model: type[BaseModel], path: list[str]) -> bool:
    """Return whether a dotted path leads to a value of a result file."""
    inner: Any = model
    for part in path:
        if isinstance(inner, UnionType):
            inner = next(each for each in get_args(inner) if each is not type(None))
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            if part not in inner.model_fields:
                return False
            inner = inner.model_fields[part].annotation
        else:
            # A place of a list, or a key of a mapping.
            inner = get_args(inner)[-1]
    return True


@pytest.mark.parametrize("name", NAMES)
def test_values_are_keys_of_the_result_files(name: str) -> None:
    files: dict[str, type[BaseModel]] = {"train": TrainReport, "eval": EvaluationFile, "fit": FitReport}
    made = {"finished", "train.least_check", "fit.reached_share", "result.placed"}
    made |= {"result.hausdorff_mm.dmp", "result.hausdorff_mm.promp", "result.geodesic_deg", "result.mean_turn_deg"}
    paths = {path for paths in load(name).values.values() for path in paths.split(" or ")} - made
    for path in paths:
        file, *rest = path.split(".")
        assert rest
        assert known(files[file], rest), path
    assert not known(EvaluationFile, ["path_deviation_mm", "least"])


@pytest.mark.parametrize("name", NAMES)
def test_the_pages_have_a_place_for_every_part(name: str) -> None:
    whole = load(name)
    page = (ROOT / whole.page).read_text(encoding="utf-8")
    for part in [*whole.tables, *whole.printed, *filter(None, [whole.machine])]:
        assert page.count(f"<!-- begin: {part} -->") == page.count(f"<!-- end: {part} -->") == 1


def test_what_is_compared_is_measured_with_the_same_seeds() -> None:
    study = load("study")
    for tables in study.tables.values():
        for pair in [pair for table in tables for pair in table.comparisons.values()]:
            one, other = (study.variants[line.partition("/")[0]].seeds or study.seeds for line in pair)
            assert set(one) & set(other)


def test_the_report_finds_what_it_shows_of_ablations() -> None:
    assert {"learned", "episodes", "oracle_queries", "success_rate", "deviation_mm"} <= set(ABLATIONS.values)


def test_deviations_are_numbered_without_gaps_and_are_twenty_at_most() -> None:
    numbers = [int(number) for number in re.findall(r"^\| D(\d+) \|", DEVIATIONS, re.MULTILINE)]
    assert numbers == list(range(1, len(numbers) + 1))
    assert len(numbers) <= 20
    assert {number for each in ABLATIONS.variants.values() for number in each.undoes} == set(numbers)
    assert all(ABLATIONS.variants[name].undoes for name in UNDOING)


def test_no_page_or_line_of_code_names_a_deviation_that_is_not_there() -> None:
    numbered = set(re.findall(r"^\| D(\d+) \|", DEVIATIONS, re.MULTILINE))
    files = [*ROOT.glob("*.md"), *(path for name in ("docs", "conf", "koopdqn") for path in (ROOT / name).rglob("*.*"))]
    for path in files:
        if path.suffix in (".md", ".py", ".yaml"):
            assert set(re.findall(r"(?<!#)\bD(\d+)\b", path.read_text(encoding="utf-8"))) <= numbered, path


@pytest.mark.parametrize("name", UNDOING)
def test_a_deviations_row_gives_the_overrides_that_undo_it(name: str) -> None:
    last = {
        int(line.split("|")[1].strip().removeprefix("D")): set(re.findall(r"[\w.]+=[^\s`]+", line.split("|")[6]))
        for line in DEVIATIONS.splitlines()
        if line.startswith("| D")
    }

    def same(item: str) -> str:
        key, _, value = item.partition("=")
        try:
            return f"{key}={float(value)}"
        except ValueError:
            return item

    undoing = re.findall(r"`(\S+)`", ABLATIONS.config(*ABLATIONS.variants[name].train))
    assert undoing
    assert {same(item) for item in undoing} <= {
        same(item) for number in ABLATIONS.variants[name].undoes for item in last[number]
    }


@pytest.mark.parametrize("task", ["shelf", "knife"])
def test_every_setting_in_which_the_paper_preset_differs_is_named_among_the_deviations(task: str) -> None:
    default, paper = (leaves(tree(f"task={task}", f"preset={preset}")) for preset in ("default", "paper"))
    # Intent and trust are whole options of their groups.
    differ = {
        name for name in default if not name.startswith(("intent.", "trust.")) and default[name] != paper.get(name)
    }
    assert len(differ) > 20
    for name in sorted(differ - {"agent.name"}):
        last = name.rpartition(".")[2]
        assert last in DEVIATIONS or {"gamma": "γ"}.get(last, last) in DEVIATIONS, name


def test_the_functions_of_algorithm_1_exist() -> None:
    section = ALGORITHM.partition("## Algorithm 1")[2].partition("\n## ")[0]
    owner: Any = None
    found = 0
    for name in re.findall(r"`(\.?\w[\w.]*)`", section):
        if name.startswith("."):
            assert hasattr(owner, name[1:]), name
        else:
            parts = name.split(".")
            module = importlib.import_module(f"koopdqn.{parts[0]}.{parts[1]}")
            for part in parts[2:]:
                owner, module = module, getattr(module, part)
        found += 1
    assert found > 20


def test_of_one_key_the_last_override_counts() -> None:
    assert merged(("a=1", "b=2"), ("a=3",)) == ("a=3", "b=2")
    shown = experiment(train=["seed={seed}", "train.max_steps=7"]).config("train.max_steps=3", "reward.shape=sign")
    assert shown == "`reward.shape=sign`"


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"variants": {"default": {}, "x": {"of": "y"}}}, "unknown variant 'y'; valid: default, x"),
        ({"variants": {"default": {"cases": ["moon"]}}}, "unknown case 'moon'; valid: knife, shelf"),
        (
            {"tables": {"part": [{"labels": {}, "columns": {"a": {"value": "b"}}}]}},
            "unknown value 'b'; valid: demonstrations",
        ),
        (
            {"tables": {"part": [{"labels": {}, "columns": {}, "comparisons": {"a": ["default", "default/floor"]}}]}},
            "unknown line 'default/floor'; valid: default, default/greedy",
        ),
    ],
)
def test_a_name_that_is_not_there_is_told_with_the_valid_ones(changed: dict[str, Any], told: str) -> None:
    with pytest.raises(BadInputError, match=re.escape(told)):
        experiment(**changed)


def test_an_experiment_that_is_none_is_bad_input(tmp_path: Path) -> None:
    valid = "ablations, continuous, figures, people, people-continuous, study"
    with pytest.raises(BadInputError, match=f"unknown experiment 'moon'; valid: {valid}"):
        load("moon")
    own = tmp_path / "own.yaml"
    own.write_text("page: page.md\nvariant: {}\n", encoding="utf-8")
    with pytest.raises(BadInputError, match=r"unknown key own\.yaml\.variant; valid: cases"):
        load(str(own))
    with pytest.raises(ValidationError):
        Experiment.model_validate({})
