"""Writes the key tables of docs/files.md from the schemas of the result files: `make docs`.

A generated part stands between two comments, ``<!-- begin: NAME -->`` and ``<!-- end: NAME -->``.
"""

import json
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from koopdqn.app.recording.session import KeyLine, SessionLine
from koopdqn.demonstrations.schema import InspectionFile
from koopdqn.errors import BadInputError
from koopdqn.evaluation.correction import CorrectionFile
from koopdqn.evaluation.schema import EvaluationFile
from koopdqn.intent.schema import FitReport
from koopdqn.oracles.journal import AnswerLine, DropLine, EditLine, OpinionLine, UndoLine
from koopdqn.programs.schema import ProgramFile, StreamFile
from koopdqn.report.schema import ReportFile, SweepFile
from koopdqn.rl.schema import TrainReport
from koopdqn.settings import ReportModel
from koopdqn.view.schema import CompareFile, ExplainFile

FILES: Final = Path(__file__).resolve().parents[1] / "docs" / "files.md"

TABLES: Final[Mapping[str, type[ReportModel]]] = {
    "inspect.json": InspectionFile,
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
    "explain.json": ExplainFile,
    "compare.json": CompareFile,
    "correct.json": CorrectionFile,
    "program.json": ProgramFile,
    "stream.json": StreamFile,
    "report.json": ReportFile,
    "sweep.json": SweepFile,
}
"""The generated tables of docs/files.md and the schemas they come from."""

_UNIT = re.compile(r"\s*\[([^\[\]]+)\]$")
_SHAPE = re.compile(r"^(\([^)]*\)) ")
_SUFFIXES = {"_mm": "mm", "_m_s": "m/s", "_m": "m", "_deg": "deg", "_rad": "rad", "_seconds": "s"}
_NAMES = {"number": "number", "integer": "whole number", "boolean": "true or false", "string": "text"}


def replaced(text: str, name: str, content: str) -> str:
    """Return a text with the generated part of that name replaced.

    Raises:
        BadInputError: the text does not hold that part exactly once.
    """
    pattern = re.compile(rf"(<!-- begin: {re.escape(name)} -->\n).*?(<!-- end: {re.escape(name)} -->)", re.DOTALL)
    new, count = pattern.subn(lambda match: f"{match[1]}\n{content.strip()}\n\n{match[2]}", text)
    if count != 1:
        raise BadInputError(f"the generated part {name} must stand in the text once, found it {count} times")
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


def main() -> int:
    """Write the key tables."""
    FILES.write_text(with_tables(FILES.read_text(encoding="utf-8")), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
