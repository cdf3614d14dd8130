"""Tries to break koopdqn and counts: `make fuzz`, `make soak`, `make physics`; the counts go to docs/reliability.md.

    python scripts/prove.py fuzz --minutes 10 --seed 1
    python scripts/prove.py soak --minutes 20
    python scripts/prove.py physics --runs runs/shelf runs/knife --paths 1000

Counts of another seed are added to those that are known; --fresh forgets these. Exit status 0 if nothing was found, 1
if something was: it is printed with the seed and the number that make it again (--only NUMBER).
"""

import argparse
import json
import os
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from docs import replaced, rows_table
from koopdqn.app.exit_status import guard
from koopdqn.files import write_json, write_text

ROOT: Final = Path(__file__).resolve().parents[1]
# Small runs and recordings of all kinds are those of the tests.
sys.path.append(str(ROOT / "tests"))
PAGE: Final = ROOT / "docs" / "reliability.md"
KNOWN: Final = ROOT / "docs" / "reliability.json"
LONGEST_S: Final = 60.0
_ASLEEP: Final = 10
MOST_BYTES: Final = 2 * 10**9
ENDS: Final = ("done", "refused", "failed", "hang", "crash", "memory", "wrong")
"""What comes of an input; the last four are faults."""
FAULTS: Final = ENDS[3:]
KILLS: Final = "kills"
"""Beside the ends of a killed training: how often it was killed."""


@dataclass(frozen=True)
class Case:
    """One input.

    Attributes:
        family: in whose row it is counted.
        name: what it is, to find it again.
        run: tries it, and returns one of :data:`ENDS` and a detail.
    """

    family: str
    name: str
    run: Callable[[], tuple[str, str]]


def cpu_seconds(process: int) -> float:
    """Return how long a process, and what it waited for, has computed [s]; the clock says little on a busy machine."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


class Watched:
    """Runs cases in a process of its own, which is replaced when it hangs, dies or grows."""

    def __init__(self, make: Callable[[int], Case]) -> None:
        """Take what makes a case of a number."""
        self._make = make
        self._child = 0
        self._pipes = (-1, -1)

    def results(self, numbers: Iterator[int], until: float) -> Iterator[tuple[int, dict[str, str]]]:
        """Yield number and result of each case until a moment of the monotonic clock."""
        for number in numbers:
            if time.monotonic() > until:
                break
            yield number, self._result(number)
        self._end()

    def _result(self, number: int) -> dict[str, str]:
        if not self._child:
            self._begin()
        os.write(self._pipes[1], number.to_bytes(8, "little"))
        ready = self._waited()
        line = os.read(self._pipes[0], 1 << 16) if ready else b""
        if line:
            found: dict[str, str] = json.loads(line)
            # What grew stays large, and would be taken for what comes next.
            if found["end"] == "memory":
                self._end()
            return found
        self._end()
        case = self._make(number)
        return {"family": case.family, "name": case.name, "end": "crash" if ready else "hang", "detail": ""}

    def _waited(self) -> bool:
        """Return whether the process answers before it has computed, or done nothing, for too long."""
        until, most = time.monotonic() + _ASLEEP * LONGEST_S, cpu_seconds(self._child) + LONGEST_S
        while time.monotonic() < until and cpu_seconds(self._child) < most:
            if select.select([self._pipes[0]], [], [], 1.0)[0]:
                return True
        return False

    def _begin(self) -> None:
        (ours, their_out), (their_in, our_out) = os.pipe(), os.pipe()
        self._child = os.fork()
        if self._child == 0:
            os.close(ours)
            os.close(our_out)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            while content := os.read(their_in, 8):
                os.write(their_out, json.dumps(self._tried(int.from_bytes(content, "little"))).encode())
            os._exit(0)
        os.close(their_out)
        os.close(their_in)
        self._pipes = ours, our_out

    def _tried(self, number: int) -> dict[str, str]:
        case = self._make(number)
        try:
            end, detail = case.run()
        # whatever escapes is what is looked for
        except BaseException as error:
            end, detail = "wrong", f"{type(error).__name__}: {error}"
        usage = (resource.getrusage(each).ru_maxrss << 10 for each in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
        if max(usage) > MOST_BYTES:
            end, detail = "memory", detail
        return {"family": case.family, "name": case.name, "end": end, "detail": detail[:300]}

    def _end(self) -> None:
        if self._child:
            os.kill(self._child, signal.SIGKILL)
            os.waitpid(self._child, 0)
            for pipe in self._pipes:
                os.close(pipe)
            self._child = 0


def fuzz(seed: int, minutes: float, only: int | None, folder: Path) -> Counter[tuple[str, str]]:
    """Return how often each end of each family was seen."""
    from prove_fuzz import Fuzz

    make = Fuzz(seed, folder).case
    until, counts, began = time.monotonic() + 60.0 * minutes, Counter[tuple[str, str]](), time.monotonic()
    numbers = iter([only]) if only is not None else iter(range(1 << 62))
    for number, found in Watched(make).results(numbers, until):
        counts[found["family"], found["end"]] += 1
        if found["end"] in FAULTS or only is not None:
            print(
                f"--seed {seed} --only {number}: {found['family']}, {found['name']}: {found['end']} {found['detail']}"
            )
        if number % 1000 == 999:
            print(f"{number + 1} inputs in {time.monotonic() - began:.0f} s", flush=True)
    return counts


def write_counts(name: str, seed: int, counts: Counter[tuple[str, str]], *, fresh: bool) -> None:
    """Add counts to those that are known, and write all as tables."""
    known: dict[str, Any] = json.loads(KNOWN.read_text(encoding="utf-8")) if KNOWN.exists() else {}
    if fresh:
        known.pop(name, None)
    rows: dict[str, dict[str, int]] = {}
    for (family, end), count in counts.items():
        rows.setdefault(family, {})[end] = count
    known.setdefault(name, {})[str(seed)] = rows
    write_json(KNOWN, known)
    write_tables(known)


def write_tables(known: dict[str, Any]) -> None:
    """Write the known counts into the page."""
    text = PAGE.read_text(encoding="utf-8")
    for name, heads in (("fuzz", ("inputs", *ENDS)), ("soak", ("runs", KILLS, *ENDS))):
        total: dict[str, Counter[str]] = {}
        for rows in known.get(name, {}).values():
            for family, ends in rows.items():
                total.setdefault(family, Counter()).update(ends)
        whole = sum(total.values(), Counter[str]())
        table = [
            (family, *map(str, (sum(ends[end] for end in ENDS), *(ends[head] for head in heads[1:]))))
            for family, ends in [*sorted(total.items()), ("all", whole)]
        ]
        text = replaced(text, name, rows_table(("", *heads), table))
    from prove_physics import table as physics

    text = replaced(text, "physics", physics(known.get("physics", {})))
    write_text(PAGE, text)


def main() -> int:
    """Try what the command line names; print and write the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("fuzz", "soak", "physics"))
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int)
    parser.add_argument("--fresh", action="store_true")
    parser.add_argument("--runs", nargs="*", default=[], type=Path)
    parser.add_argument("--paths", type=int, default=1000)
    given = parser.parse_args()
    if given.what == "physics" and not given.runs:
        parser.error("physics needs --runs, folders of trained runs")
    return guard(lambda: _tried(given), debug=False)


def _tried(given: argparse.Namespace) -> int:
    folder = Path(tempfile.mkdtemp(prefix="koopdqn-prove-"))
    try:
        if given.what == "physics":
            from prove_physics import measured

            known = json.loads(KNOWN.read_text(encoding="utf-8")) if KNOWN.exists() else {}
            known["physics"] = ({} if given.fresh else known.get("physics", {})) | measured(given.runs, given.paths)
            write_json(KNOWN, known)
            write_tables(known)
            return 0
        if given.what == "fuzz":
            counts = fuzz(given.seed, given.minutes, given.only, folder)
        else:
            from prove_soak import soak

            counts = soak(given.seed, given.minutes, folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    for (family, end), count in sorted(counts.items()):
        print(f"{family:<32} {end:<8} {count}")
    if given.only is None:
        write_counts(given.what, given.seed, counts, fresh=given.fresh)
    return int(any(end in FAULTS for _, end in counts))


if __name__ == "__main__":
    sys.exit(main())
