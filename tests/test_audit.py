"""What was not looked up counts as a fault, and so does what cannot be."""

import json
from typing import Any

import audit
import pytest

SOUND = {"name": "numpy", "version": "2.0.0", "vulns": []}
FLAWED = {"name": "pillow", "version": "9.0.0", "vulns": [{"id": "PYSEC-1", "fix_versions": ["9.0.1"]}]}
UNKNOWN = {"name": "scipy", "skip_reason": "Dependency not found on PyPI"}
OWN = {"name": "koopdqn", "skip_reason": "Dependency not found on PyPI"}


@pytest.mark.parametrize(
    ("found", "status", "line"),
    [
        ([SOUND, OWN], 0, "audit: no known flaw in 1 dependencies"),
        ([SOUND, FLAWED, OWN], 1, "audit: pillow 9.0.0: PYSEC-1, mended in 9.0.1"),
        ([SOUND, UNKNOWN], 1, "audit: every dependency must be looked up, found 1 that the database lacks: scipy"),
    ],
)
def test_the_verdict(found: list[dict[str, Any]], status: int, line: str) -> None:
    assert audit.verdict(json.dumps({"dependencies": found}), "") == (status, [line])


@pytest.mark.parametrize("output", ["", "[]", "{}"])
def test_a_database_out_of_reach_is_one_clear_line(output: str) -> None:
    status, (line,) = audit.verdict(output, "Traceback\nERROR: connection refused\n")
    assert status == 1
    assert line == "audit: pip-audit must reach the database of known flaws, says: ERROR: connection refused"
