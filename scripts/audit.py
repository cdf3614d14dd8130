"""Looks up known flaws of the installed dependencies: `make audit`. Needs the network.

Exit status 0 if every dependency was looked up and none has a known flaw, 1 otherwise: a dependency that the database
does not know, or a database that cannot be reached, is no proof that there is no flaw.
"""

import json
import subprocess
import sys
from collections.abc import Sequence
from typing import Any, Final

_OWN: Final = "koopdqn"
_SHOWN: Final = 5


def verdict(output: str, errors: str) -> tuple[int, list[str]]:
    """Return the exit status and the lines to print for what pip-audit printed.

    Args:
        output: its standard output, JSON if it came so far.
        errors: its standard error.
    """
    try:
        found: list[dict[str, Any]] = json.loads(output)["dependencies"]
    except (ValueError, KeyError, TypeError):
        said = [line.strip() for line in errors.splitlines() if line.strip()] or ["nothing"]
        return 1, [f"audit: pip-audit must reach the database of known flaws, says: {said[-1][:300]}"]
    others = [each for each in found if each["name"] != _OWN]
    flaws = [(each["name"], each["version"], flaw) for each in others for flaw in each.get("vulns", [])]
    missed = [each["name"] for each in others if "skip_reason" in each]
    lines = [
        f"audit: {name} {version}: {flaw['id']}, mended in {', '.join(flaw['fix_versions']) or 'no release yet'}"
        for name, version, flaw in flaws
    ]
    if missed:
        shown = ", ".join(missed[:_SHOWN]) + (f" and {len(missed) - _SHOWN} more" if len(missed) > _SHOWN else "")
        lines.append(f"audit: every dependency must be looked up, found {len(missed)} that the database lacks: {shown}")
    if not lines:
        lines = [f"audit: no known flaw in {len(others)} dependencies"]
    return int(bool(flaws or missed)), lines


def main(arguments: Sequence[str] = ()) -> int:
    """Run pip-audit on this interpreter's environment, with further arguments of its own."""
    command = [
        sys.executable,
        "-m",
        "pip_audit",
        "--local",
        "--format",
        "json",
        "--progress-spinner",
        "off",
        *arguments,
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    status, lines = verdict(done.stdout, done.stderr)
    print("\n".join(lines), file=sys.stderr if status else sys.stdout)
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
