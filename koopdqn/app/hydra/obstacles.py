"""Obstacles on the command line: whatever named them, the override that a run records holds them, and no file."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from koopdqn.tasks.obstacles import Obstacle


def obstacles_of(path: Path) -> str:
    """Return the override that holds the obstacles of a file.

    Raises:
        BadInputError: the file is missing or no YAML, or an obstacle breaks a rule.
    """
    from koopdqn.tasks.obstacles import read_obstacles

    return _override(read_obstacles(path))


def with_meshes_read(override: str) -> str:
    """Return an override of obstacles with the corners of meshes in place of their files, if it is a list of them.

    Raises:
        BadInputError: an obstacle breaks a rule.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import OverrideParseException

    from koopdqn.tasks.obstacles import checked_obstacles

    try:
        found = OverridesParser.create().parse_override(override).value()
    except OverrideParseException:
        found = None
    return _override(checked_obstacles({"obstacles": found})) if isinstance(found, list) else override


def _override(found: Sequence["Obstacle"]) -> str:
    from koopdqn.artifact import described

    each = [described(obstacle) for obstacle in found]
    nodes = [",".join(f"{key}:{_grammar(held)}" for key, held in node.items() if key != "target") for node in each]
    return f"++task.obstacles=[{','.join(f'{{{node}}}' for node in nodes)}]"


def _grammar(value: object) -> str:
    if isinstance(value, list | tuple):
        return f"[{','.join(_grammar(each) for each in value)}]"
    # Texts are names and shapes alone, of letters.
    return f"'{value}'" if isinstance(value, str) else repr(value)
