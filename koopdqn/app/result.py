"""What a command gives back to the command line."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from rich.console import RenderableType


@dataclass(frozen=True)
class CommandResult:
    """The outcome of a command.

    Attributes:
        result: what the command's result file holds; ``--json`` prints it. JSON values only, no NaN.
        lines: what a person reads on standard output without ``--json``: texts (plain, no markup) or Rich
            renderables.
        objective: the value returned to Hydra's sweepers, or None.
        exit_status: 0 done, 1 the work itself failed (not learned).
    """

    result: dict[str, Any]
    lines: Sequence[RenderableType] = field(default_factory=tuple)
    objective: float | None = None
    exit_status: int = 0
