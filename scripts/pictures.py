"""Draws the pictures of the documentation anew, from one run: `make pictures`."""

import io
import re
import sys
from pathlib import Path
from typing import Final

from koopdqn.app.api import fit as fit_intent
from koopdqn.app.api import generate, intent_reward, load_config, open_workcell
from koopdqn.console import LiteralConsole
from koopdqn.files import write_text
from koopdqn.intent.fit import agent_steps
from koopdqn.oracles.scripted import ScriptedOracle
from koopdqn.rl.algorithm1 import Trainer
from koopdqn.rl.history import Check
from koopdqn.view.dashboard import Dashboard

IMAGES: Final = Path(__file__).resolve().parents[1] / "docs" / "images"
SIZES: Final = ((80, 24), (140, 40))
_FETCHED: Final = re.compile(r"@font-face \{.*?\}", re.DOTALL)


def dashboards(folder: Path) -> None:
    """Write the dashboard at two sizes, as it stands after the third check of a training."""
    config = load_config("task=shelf", "seed=0")
    workcell, shown = open_workcell(config), generate(config)
    fitted = fit_intent(config, shown)
    trainer = Trainer(
        workcell,
        intent_reward(config, fitted),
        fitted.model.start_frame.each(agent_steps(shown, config.task)),
        ScriptedOracle(config.task),
        config.agent,
        config.train,
        config.inputs.seed,
        config.feedback,
    )
    pages = [LiteralConsole(record=True, width=w, height=h, file=io.StringIO(), force_terminal=True) for w, h in SIZES]
    boards = [Dashboard(trainer, [item.poses for item in shown.items], None, page) for page in pages]

    def on_check(check: Check) -> None:
        if len(trainer.history.checks) == 3:
            for page, board in zip(pages, boards, strict=True):
                page.print(board.content())
                # What is shown fetches nothing.
                text = _FETCHED.sub("", page.export_svg(title="koopdqn train task=shelf"))
                write_text(folder / f"dashboard-{page.width}x{page.height}.svg", text)

    trainer.run(on_check)


if __name__ == "__main__":
    dashboards(IMAGES)
    sys.exit(0)
