"""Writes the generated parts of the documentation: `make docs` the key tables, `make figures` what is measured.

A generated part stands between two comments, ``<!-- begin: NAME -->`` and ``<!-- end: NAME -->``. The key
tables of docs/files.md come from the schemas of the result files and take a moment. With ``--measure`` the
README's figures and pictures are made anew, too: tasks are learned and measured for several seeds, which takes
minutes.
"""

import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from koopdqn.app.recording.session import KeyLine, SessionLine
from koopdqn.evaluation.schema import EvaluationFile
from koopdqn.intent.schema import FitReport
from koopdqn.oracles.journal import AnswerLine, DropLine, EditLine, OpinionLine, UndoLine
from koopdqn.report.runs import ReportFile
from koopdqn.rl.schema import TrainReport
from koopdqn.schema import ReportModel

ROOT: Final = Path(__file__).resolve().parents[1]
README: Final = ROOT / "README.md"
FILES: Final = ROOT / "docs" / "files.md"
IMAGES: Final = ROOT / "docs" / "images"

TABLES: Final[Mapping[str, type[ReportModel]]] = {
    "fit.json": FitReport,
    "train.json": TrainReport,
    "feedback.jsonl": AnswerLine,
    "feedback.jsonl, undo": UndoLine,
    "feedback.jsonl, edit": EditLine,
    "feedback.jsonl, drop": DropLine,
    "feedback.jsonl, opinion": OpinionLine,
    "keys.jsonl": SessionLine,
    "keys.jsonl, key": KeyLine,
    "eval.json": EvaluationFile,
    "report.json": ReportFile,
}
"""The generated tables of docs/files.md and the schemas they come from."""

TASKS: Final = ("shelf", "knife")
SEEDS: Final = (0, 1, 2)
INTENTS: Final = ("pose", "paper")

_UNIT = re.compile(r"\s*\[([^\[\]]+)\]$")
_SHAPE = re.compile(r"^(\([^)]*\)) ")
_SUFFIXES = {"_mm": "mm", "_m_s": "m/s", "_m": "m", "_deg": "deg", "_rad": "rad", "_seconds": "s"}
_NAMES = {"number": "number", "integer": "whole number", "boolean": "true or false", "string": "text"}


def replaced(text: str, name: str, content: str) -> str:
    """Return a text with the generated part of that name replaced.

    Raises:
        ValueError: the text does not hold that part exactly once.
    """
    pattern = re.compile(rf"(<!-- begin: {re.escape(name)} -->\n).*?(<!-- end: {re.escape(name)} -->)", re.DOTALL)
    new, count = pattern.subn(lambda match: f"{match[1]}\n{content.strip()}\n\n{match[2]}", text)
    if count != 1:
        raise ValueError(f"the generated part {name} must stand in the text once, found it {count} times")
    return new


def rows_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join(lines)


def key_table(model: type[ReportModel]) -> str:
    """Return the Markdown table of every key of a result file, keys of objects written with dots."""
    schema = model.model_json_schema()
    known = {base.__name__ for base in model.__mro__}
    rows: list[tuple[str, ...]] = []

    def add(properties: Mapping[str, Any], prefix: str, unit: str) -> None:
        for name, node in properties.items():
            kind, inner = _kind(node)
            own = _unit(name, node["description"]) or unit
            meaning = _UNIT.sub("", node["description"])
            shape = _SHAPE.match(meaning)
            meaning = _SHAPE.sub("", meaning)
            below = inner.rpartition("/")[2]
            if below in known:
                meaning += "; its keys are those of a method, as above"
            shown = own if _is_quantity(kind) else ""
            rows.append((f"`{prefix}{name}`", kind, shape[1] if shape else _length(node), shown or "–", meaning))
            if below and below not in known:
                mark = "[]" if kind.startswith("list") else ".NAME" if kind.startswith("object of") else ""
                add(schema["$defs"][below]["properties"], f"{prefix}{name}{mark}.", own)

    add(schema["properties"], "", "")
    return rows_table(("key", "type", "shape", "unit", "meaning"), rows)


def _unit(name: str, description: str) -> str:
    """Return a key's unit: what its description ends with, else what its name ends with."""
    found = _UNIT.search(description)
    return found[1] if found else next((unit for suffix, unit in _SUFFIXES.items() if name.endswith(suffix)), "")


def _is_quantity(kind: str) -> bool:
    return kind.startswith(("number", "list of numbers")) and "from 0 to 1" not in kind


def _length(node: Mapping[str, Any]) -> str:
    length = node.get("minItems")
    return f"({length},)" if length is not None and length == node.get("maxItems") else "–"


def _kind(node: Mapping[str, Any]) -> tuple[str, str]:
    """Return a JSON schema node's type in words, and the reference to the object in it or an empty text."""
    if "anyOf" in node:
        (kind, inner), _ = (_kind(option) for option in node["anyOf"])
        return f"{kind} or null", inner
    if "$ref" in node:
        return "object", str(node["$ref"])
    if "const" in node or "enum" in node:
        return " or ".join(f"`{json.dumps(value)}`" for value in node.get("enum", [node.get("const")])), ""
    if node["type"] == "array":
        kind, inner = _kind(node["items"])
        return f"list of {_plural(kind)}", inner
    if node["type"] == "object":
        kind, inner = _kind(node["additionalProperties"])
        return f"object of {_plural(kind)}", inner
    if node["type"] == "null":
        return "null", ""
    kind = _NAMES[node["type"]]
    return (f"{kind} from 0 to 1" if (node.get("minimum"), node.get("maximum")) == (0, 1) else kind), ""


def _plural(kind: str) -> str:
    return re.sub(r"(number|object|text)\b", r"\1s", kind, count=1)


def with_tables(text: str) -> str:
    """Return the text of docs/files.md with its key tables as the schemas have them."""
    for name, model in TABLES.items():
        text = replaced(text, name, key_table(model))
    return text


def koopdqn(folder: Path, *arguments: str) -> str:
    """Run the program in a folder and return its standard output; progress goes to the terminal."""
    program = Path(sys.executable).with_name("koopdqn")
    print("$ koopdqn", *arguments, file=sys.stderr, flush=True)
    done = subprocess.run(
        [program, *arguments],
        cwd=folder,
        env={**os.environ, "COLUMNS": "100", "NO_COLOR": "1"},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return done.stdout


def demo_output(folder: Path) -> str:
    """Return what `make demo` prints on standard output."""
    printed = [koopdqn(folder, "train", "task=shelf", "seed=0"), koopdqn(folder, "eval")]
    lines = "".join(printed).splitlines()
    return "```text\n" + "\n".join(line.rstrip() for line in lines if line.strip()) + "\n```"


def measured_runs(folder: Path) -> dict[str, list[dict[str, Any]]]:
    """Train and evaluate every task with every seed; return the result files' contents by task."""
    runs: dict[str, list[dict[str, Any]]] = {}
    for task in TASKS:
        for seed in SEEDS:
            run, evaluation = f"{task}-{seed}", f"{task}-{seed}-eval"
            koopdqn(folder, "train", f"task={task}", f"seed={seed}", f"out={run}")
            koopdqn(folder, "eval", f"run={run}", f"out={evaluation}")
            fits = {}
            for intent in INTENTS:
                given = (f"task={task}", f"intent={intent}", f"demos={run}/demos.hdf5", f"out={run}-{intent}")
                koopdqn(folder, "fit", *given)
                fits[intent] = _json(folder / f"{run}-{intent}" / "fit.json")
            found = {"train": _json(folder / run / "train.json"), "eval": _json(folder / evaluation / "eval.json")}
            runs.setdefault(task, []).append({**found, "fit": fits})
        shutil.copyfile(folder / f"{task}-0-eval" / "eval.png", IMAGES / f"{task}.png")
    return runs


def learning_table(runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Return the table of what learning took: means over the seeds, the range in brackets."""
    rows = []
    for task, of_task in runs.items():
        trained = [run["train"] for run in of_task]
        agreement = [report["reward_agreement"]["trusted"] for report in trained]
        rows.append(
            (
                task,
                f"{sum(report['learned'] for report in trained)} of {len(trained)}",
                _spread([report["seconds"] for report in trained], "{:.0f} s"),
                _spread([report["env_steps"] for report in trained], "{:,.0f}"),
                _spread([report["oracle_queries"] for report in trained], "{:,.0f}"),
                _spread([share for share in agreement if share is not None], "{:.1%}"),
            )
        )
    heads = ("task", "learned", "time", "actions tried", "questions", "rewards that the demonstrator agrees with")
    return rows_table(heads, rows)


def results_table(runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Return the table of the learned policy beside the baselines: means over the seeds, the range in brackets."""
    rows = []
    for task, of_task in runs.items():
        evaluations = [run["eval"] for run in of_task]
        for method in ("policy", *evaluations[0]["baselines"]):
            found = [report if method == "policy" else report["baselines"][method] for report in evaluations]
            rows.append(
                (
                    task,
                    method.replace("_", " "),
                    _spread([report["success_rate"] for report in found], "{:.1%}"),
                    _spread([report["path_deviation_mm"]["mean"] for report in found], "{:.1f} mm"),
                    _spread([report["lateral_deviation_mm"]["mean"] for report in found], "{:.1f} mm"),
                )
            )
    return rows_table(("task", "method", "success", "deviation by arc length", "deviation sideways"), rows)


def intent_table(runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Return the table of the intent models: held-out errors of one step, and of rolling out to the end."""
    rows = []
    for task, of_task in runs.items():
        for intent in INTENTS:
            fits = [run["fit"][intent] for run in of_task]
            reached = sum(report["roll_out_error_m"]["reached_goal"] for report in fits)
            rows.append(
                (
                    task,
                    f"`intent={intent}`",
                    _spread([1e3 * report["one_step_error_m"]["rms"] for report in fits], "{:.2f} mm"),
                    f"{reached} of {sum(report['demonstrations'] for report in fits)}",
                    _spread([1e3 * report["roll_out_error_m"]["median_hausdorff"] for report in fits], "{:.1f} mm"),
                )
            )
    heads = ("task", "intent", "one step, RMS", "rolled out: goal reached", "median Hausdorff distance")
    return rows_table(heads, rows)


def _spread(values: Sequence[float], form: str) -> str:
    if not values:
        return "–"
    low, mean, high = (form.format(value) for value in (min(values), statistics.fmean(values), max(values)))
    return mean if low == high else f"{mean} ({low.split()[0].rstrip('%')}–{high.split()[0].rstrip('%')})"


def _json(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return content


MEASURED: Final[Mapping[str, Callable[[Mapping[str, Sequence[Mapping[str, Any]]]], str]]] = {
    "learning": learning_table,
    "results": results_table,
    "intents": intent_table,
}
"""The README's measured tables and what makes them from all runs; ``demo`` and ``machine`` are its other parts."""


def machine() -> str:
    """Return a sentence about what the figures are measured on, and how busy it is before."""
    return f"Measured on {os.cpu_count()} cores; the load average before the first run was {os.getloadavg()[0]:.1f}."


def measure() -> None:
    """Measure everything the README states and write it there."""
    IMAGES.mkdir(exist_ok=True)
    measured_on = machine()
    with tempfile.TemporaryDirectory(prefix="koopdqn-docs-") as name:
        printed = demo_output(Path(name))
        runs = measured_runs(Path(name))
    text = replaced(README.read_text(encoding="utf-8"), "demo", printed)
    text = replaced(text, "machine", measured_on)
    for part, table in MEASURED.items():
        text = replaced(text, part, table(runs))
    README.write_text(text, encoding="utf-8")


def main(arguments: Sequence[str]) -> int:
    """Write the generated parts; with ``--measure`` those of the README, too."""
    if set(arguments) - {"--measure"}:
        print(f"usage: docs.py [--measure], found {' '.join(arguments)}", file=sys.stderr)
        return 2
    FILES.write_text(with_tables(FILES.read_text(encoding="utf-8")), encoding="utf-8")
    if arguments:
        measure()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
