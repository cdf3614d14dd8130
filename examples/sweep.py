"""A sweep over seeds and settings through Hydra's multirun, gathered into one table.

Run it with ``python examples/sweep.py runs/my-sweep``.
"""

import json
import subprocess
import sys
from pathlib import Path

SEEDS, GAMMAS = "0,1,2", "0,0.5"


def main(folder: Path, *overrides: str) -> None:
    """Train every combination below a folder and print a line each; later overrides win."""
    command = [sys.executable, "-m", "koopdqn", "train", "-m", "task=shelf", f"seed={SEEDS}", f"agent.gamma={GAMMAS}"]
    subprocess.run([*command, f"out={folder}", *overrides], check=False)
    for path in sorted(folder.glob("*/train.json")):
        report = json.loads(path.read_text(encoding="utf-8"))
        print(
            f"{path.parent.name}: seed {report['seed']}, learned {report['learned']}, {report['seconds']:.1f} s,"
            f" {report['oracle_queries']} questions, best success {report['best_success_rate']:.0%}"
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
