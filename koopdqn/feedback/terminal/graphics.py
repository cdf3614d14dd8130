"""Which way of drawing pictures a terminal knows."""

import os
import re
from collections.abc import Mapping
from typing import Final, Literal

from koopdqn.errors import BadInputError
from koopdqn.feedback.terminal.device import Device

Graphics = Literal["auto", "blocks", "kitty", "sixel", "none"]
Drawn = Literal["blocks", "kitty", "sixel", "none"]

_WAIT_SECONDS: Final = 0.5
"""How long a terminal may take to say what it is: over SSH a round trip takes up to a few tenths."""
_KITTY_QUERY: Final = "\x1b_Gi=31,s=1,v=1,a=q,t=d,f=24;AAAA\x1b\\"
_KITTY_KNOWN: Final = "\x1b_Gi=31;OK"
# Every terminal answers this one, so that no one waits for an answer that never comes.
_DEVICE_QUERY: Final = "\x1b[c"
_DEVICE_ANSWER: Final = re.compile(r"\x1b\[\?([\d;]*)c")
_SIXEL_ATTRIBUTE: Final = "4"


def check_graphics(wanted: Graphics, key: str, environment: Mapping[str, str] = os.environ) -> None:
    """Raise BadInputError, which names the setting's key, if pictures cannot be drawn the wanted way here."""
    if wanted == "kitty" and _multiplexed(environment):
        raise BadInputError(
            f"{key}: must be auto, blocks, sixel or none inside tmux or screen, which pass no kitty"
            " pictures on, found kitty"
        )


def choose_graphics(wanted: Graphics, device: Device, environment: Mapping[str, str] = os.environ) -> Drawn:
    """Return how to draw on a terminal; for ``auto`` it is asked, on the screen of its own, and blocks are the rest."""
    if wanted != "auto":
        return wanted
    # tmux and screen would take kitty's query for the title of their window.
    query = _DEVICE_QUERY if _multiplexed(environment) else _KITTY_QUERY + _DEVICE_QUERY
    answer = device.ask(query, "c", _WAIT_SECONDS)
    if _KITTY_KNOWN in answer:
        return "kitty"
    device_answer = _DEVICE_ANSWER.search(answer)
    if device_answer and _SIXEL_ATTRIBUTE in device_answer[1].split(";"):
        return "sixel"
    return "blocks"


def _multiplexed(environment: Mapping[str, str]) -> bool:
    kind = environment.get("TERM", "")
    return bool(environment.get("TMUX") or environment.get("STY")) or kind.startswith(("tmux", "screen"))
