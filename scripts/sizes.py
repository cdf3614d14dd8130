"""Measures the package: lines and modules of every room, imports in circles, imports that run upwards.

A room is a folder of the package; the modules beside the folders count as the room ``*.py``. The rooms come in the
order of import-linter's layers. The limits stand in ``[tool.koopdqn.sizes]`` of ``pyproject.toml``; with ``--check``
the exit status is 1 where one is exceeded, an import closes a circle or an import runs upwards.

Run it as ``make sizes``.
"""

import argparse
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import grimp
from rich.console import Console
from rich.table import Table

ROOT: Final = Path(__file__).resolve().parents[1]
BESIDE: Final = "*.py"
"""The name of the room of the modules beside the folders."""


@dataclass(frozen=True)
class Row:
    """A line of the table: lines and modules of a room or of the package, and the most of each; None for no limit."""

    name: str
    lines: int
    modules: int
    most_lines: int | None = None
    most_modules: int | None = None

    @property
    def holds(self) -> bool:
        """Whether neither limit is exceeded."""
        return all(
            most is None or found <= most
            for found, most in ((self.lines, self.most_lines), (self.modules, self.most_modules))
        )


def levels(layers: Sequence[str]) -> dict[str, int]:
    """Return the level of every room and module that import-linter's layers name, 0 for the highest."""
    return {name: level for level, layer in enumerate(layers) for name in layer.replace(":", " ").split()}


def measured(package: Path, layers: Sequence[str], limits: Mapping[str, Any]) -> list[Row]:
    """Return a row for each room of the package in this folder, then one for the whole."""
    files: dict[str, list[int]] = {}
    for path in package.rglob("*.py"):
        room = path.relative_to(package).parts[0]
        lines = len(path.read_text(encoding="utf-8").splitlines())
        files.setdefault(BESIDE if room == path.name else room, []).append(lines)
    level = levels(layers)
    order = sorted(files, key=lambda room: (level.get(room, len(level)), room))
    rows = [Row(room, sum(files[room]), len(files[room]), limits["rooms"].get(room)) for room in order]
    whole = sum(row.lines for row in rows), sum(row.modules for row in rows)
    return [*rows, Row("all", *whole, limits["lines"], limits["modules"])]


def circular(graph: grimp.ImportGraph) -> list[tuple[str, str]]:
    """Return few imports, as importer and imported, without which no two children of any package form a circle."""
    return sorted(pair for module in graph.modules for pair in graph.nominate_cycle_breakers(module))


def upward(graph: grimp.ImportGraph, package: str, layers: Sequence[str]) -> list[tuple[str, str]]:
    """Return the imports, as importer and imported, from a layer above the importer's own."""
    level = {f"{package}.{name}": found for name, found in levels(layers).items()}

    def level_of(module: str) -> int | None:
        return level.get(".".join(module.split(".")[:2]))

    pairs = [(module, used) for module in graph.modules for used in graph.find_modules_directly_imported_by(module)]
    return sorted(
        (module, used)
        for module, used in pairs
        if (own := level_of(module)) is not None and (other := level_of(used)) is not None and other < own
    )


def shown(rows: Sequence[Row]) -> Table:
    """Return the rows as a table, every count that has a limit beside it."""
    table = Table("room", box=None)
    table.add_column("lines", justify="right")
    table.add_column("modules", justify="right")
    for row in rows:
        counts = ((row.lines, row.most_lines), (row.modules, row.most_modules))
        table.add_row(row.name, *(str(found) if most is None else f"{found} / {most}" for found, most in counts))
    return table


def main(arguments: Sequence[str]) -> int:
    """Print the sizes and return the exit status."""
    parser = argparse.ArgumentParser(description="Lines, modules, circles and upward imports of the package.")
    parser.add_argument("--check", action="store_true", help="fail where a limit is exceeded")
    check = parser.parse_args(arguments).check
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
    package = settings["importlinter"]["root_package"]
    (layers,) = (found["layers"] for found in settings["importlinter"]["contracts"] if found["type"] == "layers")
    rows = measured(ROOT / package, layers, settings["koopdqn"]["sizes"])
    graph = grimp.build_graph(package, cache_dir=None)
    faults = {"imports that close a circle": circular(graph), "upward imports": upward(graph, package, layers)}
    console = Console(width=80)
    console.print(shown(rows))
    for name, pairs in faults.items():
        console.print(f"{name}: {len(pairs)}")
        for pair in pairs:
            console.print("  " + " -> ".join(pair), soft_wrap=True)
    holds = all(row.holds for row in rows) and not any(faults.values())
    return 1 if check and not holds else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
