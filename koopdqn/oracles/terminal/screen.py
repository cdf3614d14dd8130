"""The screen: what stands where, as lines of text for a size; it draws nothing and asks nothing."""

from dataclasses import dataclass, field
from typing import Final

from rich.console import Console
from rich.style import Style
from rich.text import Text

from koopdqn import console
from koopdqn.oracles import wording
from koopdqn.oracles.base import Question
from koopdqn.tasks.task import Task

ASPECT: Final = (4, 3)
"""Width to height of the picture."""
GAP: Final = 2
_TEXT_WIDTH: Final = 38
_LEAST_PICTURE: Final = (24, 6)
_FRAME_ROWS: Final = 5
"""The line at the top, the legend, two lines of keys and the line at the bottom."""

_DIM: Final = Style(dim=True)
_BOLD: Final = Style(bold=True)
_HEAD: Final = Style(reverse=True, bold=True)
_WENT: Final = Style(color="yellow", bold=True)
_MEANT: Final = Style(color="bright_cyan", bold=True)
_GOAL: Final = Style(color="green", bold=True)

KEYS: Final = (
    "y right   n wrong   0-9 better action   s skip   u undo",
    "p big picture   r replay motion   ? help   q pause",
)
HELP: Final = (
    "Was this motion what you would have done here?",
    "",
    "y      right: a person could have gone this way",
    "n      wrong: it is undone, and another action is tried",
    "0-9    wrong, and this action would have been right",
    "       (naming the action itself says it is right)",
    "s      skip: no answer, which is not a no",
    "u      undo the latest answer; again for the one before.",
    "       The arm asks again when it comes by",
    "p      a bigger picture, saved in the run folder",
    "r      the motion once more",
    "q      pause; the same command with run=FOLDER goes on",
    "",
    "Every answer is on disk before the next question.",
    "The motion and the model's wish are drawn larger than they",
    "are; the picture's legend says how many times.",
    "",
    "Any key goes back to the question.",
)


@dataclass(frozen=True)
class Region:
    """Where the picture goes.

    Attributes:
        left: column of its left edge, from 0.
        top: row of its upper edge, from 0.
        width: in characters; 0 where there is no room.
        rows: in characters.
    """

    left: int
    top: int
    width: int
    rows: int


@dataclass(frozen=True)
class Shown:
    """What the screen shows.

    Attributes:
        task: whose question it is.
        teacher: who is asked.
        question: the question, or None before the first.
        status: the line at the bottom.
        picture: the picture's lines of characters; none where it is drawn in pixels or not at all.
        times: how many times as far as they are the motions are drawn; 0 without a picture.
        remark: a line in place of the picture.
        help: whether to show the help instead.
    """

    task: Task
    teacher: str
    question: Question | None = None
    status: str = ""
    picture: list[Text] = field(default_factory=list)
    times: float = 0.0
    remark: str = ""
    help: bool = False


def region(width: int, height: int, *, pictures: bool) -> Region:
    """Return where the picture goes on a screen, beside the text; its sides are as 4 to 3 in pixels."""
    room, rows = width - _TEXT_WIDTH - GAP, height - _FRAME_ROWS
    # A character is about twice as high as wide.
    across = min(room, rows * 2 * ASPECT[0] // ASPECT[1])
    down = across * ASPECT[1] // (2 * ASPECT[0])
    if not pictures or across < _LEAST_PICTURE[0] or down < _LEAST_PICTURE[1]:
        return Region(0, 1, 0, 0)
    return Region(0, 1, across, down)


def compose(shown: Shown, width: int, height: int, *, pictures: bool) -> list[Text]:
    """Return the screen's ``height`` lines, each at most ``width`` characters."""
    place = region(width, height, pictures=pictures)
    body = height - 4
    if shown.help:
        lines = [Text(line) for line in HELP[:body]]
    elif shown.question is None:
        lines = [Text(""), Text("  The arm is learning; it asks when it does not know.")]
    else:
        lines = beside(_left(shown, place, body), _right(shown, shown.question, width, place, body), place.width)
    lines = (lines + [Text("")] * body)[:body]
    lines = [_head(shown, width), *lines, *(Text(line, style=_DIM) for line in KEYS), status_line(shown.status, width)]
    for line in lines:
        line.truncate(width, overflow="crop")
    return lines


def status_line(status: str, width: int) -> Text:
    """Return the line at the bottom."""
    # One short of the width: a character in the corner makes some terminals scroll.
    line = Text(status, style=_BOLD)
    line.truncate(width - 1, overflow="ellipsis")
    return line


def _head(shown: Shown, width: int) -> Text:
    question = shown.question
    text = f" koopdqn  {shown.task.name}"
    if question is not None:
        left = "" if question.left is None else f", {question.left} left"
        text += f"   question {question.number}{left}   episode {question.episode}   step {question.step}"
    text += f"   {console.visible(shown.teacher)}"
    return Text(text[:width].ljust(width), style=_HEAD)


def _left(shown: Shown, place: Region, body: int) -> list[Text]:
    if not place.width:
        return []
    if shown.remark:
        return [Text(""), *wrapped(shown.remark, place.width, _DIM)]
    lines = shown.picture or [Text("")] * place.rows
    return [*lines, *([] if not shown.times else [_legend(shown.times, place.width)])][:body]


def _legend(times: float, width: int) -> Text:
    text = Text.assemble(
        ("b", _BOLD), " before ", ("r", _WENT), " reached ", ("m", _MEANT), " model ", ("g", _GOAL), " goal"
    )
    for more in ("  xyz base axes", f"  motion drawn {times:.0f}x"):
        if len(text) + len(more) <= width:
            text += Text(more, style=_DIM)
    return text


def _right(shown: Shown, question: Question, width: int, place: Region, body: int) -> list[Text]:
    room = min(width - place.width - GAP, 2 * _TEXT_WIDTH) if place.width else width
    drawn = f" (drawn {shown.times:.0f}x)" if shown.times else ""
    lines = [
        *(wrapped(wording.place(question), room) if question.place else []),
        *wrapped(f"Was this right? The arm {wording.meaning(question.action)}.", room, _BOLD),
        _pair("moved", wording.moved(question) + drawn),
        _pair("to go", wording.remaining(question, shown.task)),
        _pair("goal", wording.nearer(question, shown.task)),
        _pair("model", wording.opinion(question)),
        *wrapped(f"Asked because {question.reason or 'the intent model is not trusted here'}.", room),
    ]
    learning = wrapped(f"Learning: {question.progress}", room, _DIM) if question.progress else []
    keys = []
    if question.earlier:
        keys += wrapped(f"Latest: {wording.recalled(question.earlier[-1])} (u)", room, _DIM)
    keys.append(Text("Better, by key (mm to the goal):", style=_BOLD))
    texts = wording.choices(question, shown.task)
    half = (len(texts) + 1) // 2
    cells = [_choice(action, text, question.action) for action, text in enumerate(texts)]
    column = max(len(cell) for cell in cells[:half]) + GAP
    for first, second in zip(cells[:half], cells[half:], strict=True):
        first.pad_right(column - len(first))
        keys.append(first + second)
    # On a small screen the question and its keys must stand, whatever else does not.
    fits = len(lines) + len(learning) + len(keys) <= body
    return [*lines, *(learning if fits else []), *keys]


def _choice(action: int, text: str, asked: int) -> Text:
    style = _DIM if text == "-" else _WENT if action == asked else Style()
    return Text.assemble((f"{action}", _BOLD if text != "-" else _DIM), "*" if action == asked else " ", (text, style))


def _pair(name: str, value: str) -> Text:
    return Text.assemble((f"{name:<6}", _DIM), value)


def wrapped(text: str, width: int, style: Style | None = None) -> list[Text]:
    """Return a text as lines of at most ``width`` characters."""
    return list(Text(text, style=style or Style()).wrap(Console(width=max(width, 1)), max(width, 1)))


def beside(left: list[Text], right: list[Text], width: int) -> list[Text]:
    """Return lines beside others, which begin behind ``width`` characters and a gap; 0 leaves the left ones out."""
    if not width:
        return right
    count = max(len(left), len(right))
    lines = []
    for row in range(count):
        first = left[row].copy() if row < len(left) else Text("")
        first.truncate(width, overflow="crop")
        first.pad_right(width - first.cell_len + GAP)
        lines.append(first + right[row] if row < len(right) else first)
    return lines
