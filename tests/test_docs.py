"""What the documentation shows is real: commands, Python, files, links and generated parts."""

import importlib.util
import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from experiment import load
from omegaconf import DictConfig, OmegaConf
from typer.main import get_command

from koopdqn.app import cli
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.hydra.compose import composed
from koopdqn.app.hydra.overrides import prepare
from koopdqn.errors import BadInputError
from koopdqn.evaluation.schema import EvaluationFile
from koopdqn.settings import ReportModel

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
# Makes the README's example a matter of seconds; that whole tasks are learned is for test_learning.
SHORT = (
    "demo.count=2",
    "intent.count=40",
    "intent.copies=2",
    "agent.warm_up=500",
    "train.check_every=10",
    "train.max_steps=3000",
    "eval.episodes=3",
    "eval.dynamics_episodes=1",
)


def blocks(language: str) -> list[str]:
    """Return the README's code blocks of a language."""
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def named_files() -> dict[str, str]:
    """Return the README's example files: blocks that begin with their own name as a comment."""
    found = {}
    for block in [*blocks("python"), *blocks("yaml")]:
        if match := re.match(r"# (\S+\.(?:py|yaml))\n", block):
            found[match[1]] = block
    return found


def shown_commands(page: Path) -> list[str]:
    """Return the command lines in a page's console blocks, comments cut off."""
    console = re.findall(r"```console\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    lines = [line[2:] for block in console for line in block.splitlines() if line.startswith("$ ")]
    return [line.partition(" #")[0].strip() for line in lines]


def command_lines() -> list[list[str]]:
    """Return the arguments of every `koopdqn …` that a page shows, in a block or within a sentence."""
    found = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        inline = re.findall(r"(?<!`)`(koopdqn [a-z][^`\n]*)`", text)
        for line in [*shown_commands(page), *inline]:
            words = shlex.split(line)
            if words[:3] == ["python", "-m", "koopdqn"]:
                found.append(words[3:])
            elif words[0] == "koopdqn":
                found.append(words[1:])
    return sorted({tuple(line): line for line in found}.values())


@pytest.fixture(scope="module")
def docs() -> ModuleType:
    """The script that writes the generated parts."""
    spec = importlib.util.spec_from_file_location("koopdqn_docs", ROOT / "scripts" / "docs.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with the README's example files, and modules found in it as `python -m` finds them."""
    for name, text in named_files().items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    shutil.copytree(ROOT / "examples", tmp_path / "examples", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "my_lab.py").touch()
    (tmp_path / "better.csv").write_text("0.436,-0.060,0.563\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.syspath_prepend(str(tmp_path / "examples"))
    monkeypatch.delitem(sys.modules, "powers", raising=False)
    return tmp_path


def stand_in_run(folder: Path, *recorded: str) -> None:
    """Make what is looked for in the folder of a finished training run before its config is composed."""
    (folder / ".hydra").mkdir(parents=True, exist_ok=True)
    (folder / ".hydra" / "overrides.yaml").write_text("".join(f"- {item}\n" for item in recorded), encoding="utf-8")
    for name in ("train.json", "policy.safetensors"):
        (folder / name).touch()


def test_there_are_commands_to_check() -> None:
    assert {"demo", "fit", "train", "eval", "doctor"} <= {line[0] for line in command_lines()}
    assert len(command_lines()) > 12


@pytest.mark.parametrize("line", command_lines(), ids=" ".join)
def test_a_command_shown_composes_to_a_valid_config(
    lab: Path, capsys: pytest.CaptureFixture[str], line: list[str]
) -> None:
    command, *arguments = line
    # A sweep's config is that of its first job; placeholders stand for values of their kind.
    arguments = [argument for argument in arguments if argument not in ("-m", "--json")]
    # What launchers and sweepers read is for them to check; they need not be installed.
    arguments = [argument for argument in arguments if not argument.startswith(("hydra/", "hydra."))]
    if "-m" in line:
        arguments = [re.sub(r"(range|interval)\(|,.*", "", argument) for argument in arguments]
    places = {"SEED": "0", "TASK": "knife"}
    arguments = [re.sub("|".join(places), lambda match: places[match[0]], argument) for argument in arguments]
    if command == "doctor":
        assert arguments == []
        return
    if line in (["compare"], ["correct"]):
        # Without runs to compare, or one to correct, it is a name and no command to type.
        return
    if command == "feedback":
        group = get_command(cli.app).commands["feedback"]  # type: ignore[attr-defined]
        if arguments:
            group.commands[arguments[0]].make_context(arguments[0], arguments[1:])
        return
    arm = [argument.removeprefix("robot.path=") for argument in arguments if argument.startswith("robot.path=")]
    for path in arm:
        (lab / path).parent.mkdir(parents=True)
        text = (ROOT / "tests" / "seven.xml").read_text(encoding="utf-8")
        (lab / path).write_text(text.replace('"flange"', '"attachment_site"'), encoding="utf-8")
    for argument in arguments:
        if argument.startswith("run="):
            made_by = "demo" if command == "demo" else "train"
            own = ["robot=mjcf", "robot.site=attachment_site"] if arm else []
            stand_in_run(lab / argument.removeprefix("run="), "task=knife", f"command={made_by}", *own)
    stand_in_run(lab / "runs" / "shelf" / "newest", "task=shelf", "command=train")
    if not any(argument.startswith("-") for argument in arguments):
        config: object = composed(prepare(command, arguments).overrides)
    else:
        shown = [] if "--cfg" in arguments else ["--cfg", "job"]
        status = cli.main([command, *arguments, *shown])
        streams = capsys.readouterr()
        assert (status, streams.err) == (0, "")
        config = OmegaConf.create(streams.out)
    assert isinstance(config, DictConfig)
    assert Configuration.load(config).inputs.command == command


def test_the_make_targets_shown_exist() -> None:
    targets = set(re.findall(r"^([a-z]+):.*## ", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    for page in PAGES:
        shown = [line for line in shown_commands(page) if line.startswith("make ")]
        shown += re.findall(r"`(make [a-z]+)`", page.read_text(encoding="utf-8"))
        named = {word for line in shown for word in shlex.split(line, comments=True)[1:] if "=" not in word}
        assert named <= targets, page.name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if not re.match(r"https?://|#", target):
            assert (page.parent / target.partition("#")[0]).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_page_names_a_place_on_somebodys_machine(page: Path) -> None:
    found = re.findall(r"(?<![\w.])/(?:work|tmp|home|root|usr|opt|mnt|var|Users)/\S*", page.read_text(encoding="utf-8"))
    assert found == []


def test_the_python_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    [example] = [block for block in blocks("python") if "koopdqn.train" in block]
    assert len(example.splitlines()) <= 20
    assert sum("import" in line for line in example.splitlines()) <= 3
    given = 'load_config("task=shelf"'
    assert given in example
    names: dict[str, Any] = {}
    short = ", ".join(f'"{override}"' for override in SHORT)
    exec(compile(example.replace(given, f"{given}, {short}"), "README.md", "exec"), names)
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == len(names["trained"].history.checks) + 1 > 1
    success, deviation = map(float, printed[-1].split())
    assert names["evaluation"].report["success_rate"] == success
    assert names["evaluation"].report["path_deviation_mm"]["mean"] == deviation


def test_the_guard_s_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    page = ROOT / "docs" / "safety.md"
    [example] = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    exec(compile(example, page.name, "exec"), {})
    assert "Refusal(" in capsys.readouterr().out


def test_a_config_is_composed_in_python_where_no_command_has_begun() -> None:
    example = (
        "from koopdqn.app.commands.configuration import Configuration; from koopdqn.app.hydra.compose import composed;"
        " print(Configuration.load(composed(['task=shelf'])).task.name)"
    )
    done = subprocess.run([sys.executable, "-c", example], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "shelf\n"), done.stderr


def test_the_example_observables_fit(lab: Path) -> None:
    [line] = [line for line in command_lines() if "intent=powers" in line]
    assert cli.main([*line, "demo.count=2", f"out={lab / 'fitted'}"]) == 0
    report = json.loads((lab / "fitted" / "fit.json").read_text(encoding="utf-8"))
    assert (report["intent"], report["lifted_dimension"]) == ("powers", 9)


def test_the_key_tables_are_what_the_schemas_say(docs: ModuleType) -> None:
    text = docs.FILES.read_text(encoding="utf-8")
    assert docs.with_tables(text) == text, "run `make docs`"


def keys_of(model: type[ReportModel]) -> set[str]:
    """Return a schema's keys, walked through the model's fields rather than its JSON schema."""
    found = set()
    for name, field in model.model_fields.items():
        found.add(name)
        for part in re.findall(r"[\w.]*\.(\w+)", str(field.annotation)):
            inner = getattr(sys.modules[model.__module__], part, None)
            if isinstance(inner, type) and issubclass(inner, ReportModel) and not issubclass(model, inner):
                mark = ".NAME" if str(field.annotation).startswith("dict") else ""
                found |= {f"{name}{mark}.{key}" for key in keys_of(inner)}
    return found


def test_a_key_table_has_a_row_for_every_key(docs: ModuleType) -> None:
    table = docs.key_table(EvaluationFile)
    rows = set(re.findall(r"^\| `([^`]+)` \|", table, re.MULTILINE))
    # Those of a method are listed once, at the top level.
    assert {
        key for key in keys_of(EvaluationFile) if not re.match(r"(holdout\.)?baselines\.\w+\.|holdout\.policy\.", key)
    } == rows
    assert {"path_deviation_mm.frechet", "dynamics.contacts.first", "baselines.greedy"} <= rows


def test_units_are_those_of_the_key_or_of_the_object_it_is_in(docs: ModuleType) -> None:
    units = {
        cells[1].strip(" `"): cells[4].strip()
        for cells in (line.split("|") for line in docs.key_table(EvaluationFile).splitlines()[2:])
    }
    assert units["path_deviation_mm.mean"] == units["dynamics.sag_mm.max"] == "mm"
    assert units["rotation_deviation_deg.max"] == "deg"
    assert units["dynamics.step_seconds"] == "s"
    assert units["success_rate"] == units["failures"] == units["dynamics.contacts.steps"] == "–"


def test_the_measured_parts_are_all_there_and_filled() -> None:
    figures = load("figures")
    parts = dict(re.findall(r"<!-- begin: (\S+) -->\n(.*?)<!-- end: \1 -->", README, re.DOTALL))
    assert set(parts) == {*figures.printed, figures.machine, *figures.tables}
    for task in figures.cases:
        for name in figures.tables:
            assert f"| {task} |" in parts[name], f"{name}: run `make figures`"
    for picture in figures.pictures:
        assert (ROOT / picture).read_bytes().startswith(b"\x89PNG")
    assert "success" in parts["demo"]
    assert re.search(r"Measured on \d+ cores; the load average before the first run was \d+\.\d\.", parts["machine"])


def test_a_generated_part_is_replaced_and_nothing_else(docs: ModuleType) -> None:
    text = "before\n<!-- begin: a -->\nold\n<!-- end: a -->\nafter\n"
    new = docs.replaced(text, "a", "new \\1")
    assert new == "before\n<!-- begin: a -->\n\nnew \\1\n\n<!-- end: a -->\nafter\n"
    assert docs.replaced(new, "a", "new \\1") == new
    with pytest.raises(BadInputError, match="part b must stand in the text once, found it 0 times"):
        docs.replaced(text, "b", "new")
