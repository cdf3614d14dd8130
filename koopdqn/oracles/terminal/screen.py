"""The question screen: its words, and what stands where as lines of text for a size; it draws and asks nothing."""

from dataclasses import dataclass, field
from itertools import zip_longest
from typing import Final

import numpy as np
from rich.style import Style
from rich.text import Text

from koopdqn import console, pose
from koopdqn.oracles.base import Answer, Earlier, Question
from koopdqn.oracles.terminal.window import (
    BOLD,
    DIM,
    GAP,
    GOAL,
    TEXT_WIDTH,
    Region,
    beside,
    framed,
    picture_lines,
    region,
    status_line,
    wrapped,
)
from koopdqn.pose import Array
from koopdqn.tasks.actions import COUNT, NAMES, legal_actions
from koopdqn.tasks.passages import leg_of
from koopdqn.tasks.task import Task

SHORT: Final = (
    "goal, turn",
    "goal",
    "turn",
    "goal, turn more",
    "+x",
    "-x",
    "+y",
    "-y",
    "+z",
    "-z",
    "model's",
    "its own way",
)
"""All actions in a word or two, in the order of :data:`koopdqn.tasks.actions.NAMES`.

The first ten and the model's stand in two columns of the text's width."""
CHOICE_KEYS: Final = "0123456789m"
"""The key that names each action as better; the last is there with continuous actions only."""
_NOTHING_M: Final = 1e-6
_LEGEND_WIDTH: Final = 32

_WENT: Final = Style(color="yellow", bold=True)
_MEANT: Final = Style(color="bright_cyan", bold=True)
_OTHER_KEYS: Final = "p big picture   r replay motion   ? help   q pause"
# Where the help tells how to name a better action.
_BETTER: Final = 4
_HELP: Final = (
    "Was this motion what you would have done here?",
    "",
    "y      right: a person could have gone this way",
    "n      wrong: it is undone, and another action is tried",
    "0-9    wrong, and this action would have been right",
    "       (naming the action itself says right)",
    "s      skip: no answer, which is not a no",
    "u      undo the latest answer; again for the one before.",
    "       The arm asks again when it comes by",
    "p      a bigger picture, saved in the run folder",
    "r      the motion once more",
    "q      pause; it says what goes on another time",
    "",
    "Every answer is on disk before the next question.",
    "The motion and the model's wish are drawn larger than they",
    "are, by the number that stands behind what was moved.",
    "",
    "Any key goes back to the question.",
)


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


def _leg(start: Array, task: Task) -> str:
    """Return which leg of how many began at a start (7,); nothing of a path that does not pass itself."""
    legs = task.legs(start)
    return f"   leg {leg_of(start, legs)} of {len(legs)}" if len(legs) > 1 else ""


def compose(shown: Shown, width: int, height: int, *, pictures: bool) -> list[Text]:
    """Return the screen's ``height`` lines, each at most ``width`` characters."""
    place = region(width, height, pictures=pictures)
    question, named = shown.question, "0-9 m" if suggests(shown.question) else "0-9"

    def body(room: int) -> list[Text]:
        if question is None:
            return [Text(""), Text("  The arm is learning; it asks when it does not know.")]
        legend_line = [legend(shown.times, place.width)] if shown.times else []
        left = picture_lines(shown.picture, legend_line, shown.remark, place)
        return beside(left, _right(shown, question, width, place, room), place.width)

    head = f" koopdqn  {shown.task.name}"
    if question is not None:
        left = "" if question.left is None else f", {question.left} left"
        head += f"   question {question.number}{left}   episode {question.episode}   step {question.step}"
        head += _leg(question.start, shown.task)
    head += f"   {console.visible(shown.teacher)}"
    keys = (f"y right   n wrong   {named} better action   s skip   u undo", _OTHER_KEYS)
    helps = help_lines(question) if shown.help else ()
    return framed(head, body, keys, helps, [status_line(shown.status, width)], width, height)


def legend(times: float, width: int = 2 * TEXT_WIDTH) -> Text:
    """Return what the letters of a picture mean, and how many times as far as they are motions are drawn."""
    words = (" before ", " reached ") if width >= _LEGEND_WIDTH else (" from ", " to ")
    text = Text.assemble(("b", BOLD), words[0], ("r", _WENT), words[1], ("m", _MEANT), " model ", ("g", GOAL), " goal")
    for more in ("  xyz base axes", f"  motion drawn {times:.0f}x"):
        if len(text) + len(more) <= width:
            text += Text(more, style=DIM)
    return text


def _right(shown: Shown, question: Question, width: int, place: Region, body: int) -> list[Text]:
    room = min(width - place.width - GAP, 2 * TEXT_WIDTH) if place.width else width
    asked_at_end = "Question {number} of about {expected} in the episode"
    drawn = f" (drawn {shown.times:.0f}x)" if shown.times and place.width else ""
    lines = [
        *(wrapped(asked_at_end.format(**vars(question.place)), room) if question.place else []),
        *wrapped(f"Was this right? The arm {NAMES[question.action]}.", room, BOLD),
        _pair("moved", moved(question) + drawn),
        _pair("to go", remaining(question, shown.task)),
        _pair("goal", nearer(question, shown.task)),
        _pair("model", opinion(question)),
        *wrapped(f"Asked because {question.reason}.", room),
    ]
    learning = wrapped(f"Learning: {question.progress}", room, DIM) if question.progress else []
    keys = []
    if question.earlier:
        keys += wrapped(f"Latest: {recalled(question.earlier[-1])} (u)", room, DIM)
    keys.append(Text("Better, by key (mm to the goal):", style=BOLD))
    texts = choices(question, shown.task)
    half = (len(texts) + 1) // 2
    cells = [_choice(action, text, question.action) for action, text in enumerate(texts)]
    column = max(len(cell) for cell in cells[:half]) + GAP
    for first, second in zip_longest(cells[:half], cells[half:], fillvalue=Text("")):
        first.pad_right(column - len(first))
        keys.append(first + second)
    # On a small screen the question and its keys must stand, whatever else does not.
    fits = len(lines) + len(learning) + len(keys) <= body
    return [*lines, *(learning if fits else []), *keys]


def _choice(action: int, text: str, asked: int) -> Text:
    style = DIM if text == "-" else _WENT if action == asked else Style()
    return Text.assemble(
        (CHOICE_KEYS[action], BOLD if text != "-" else DIM), "*" if action == asked else " ", (text, style)
    )


def _pair(name: str, value: str) -> Text:
    return Text.assemble((f"{name:<6}", DIM), value)


def moved(question: Question) -> str:
    """Return how far the action went, in position and in rotation."""
    return _amounts(question.reached, question.pose)


def remaining(question: Question, task: Task) -> str:
    """Return how far the goal is after the action, in position and in rotation."""
    return _amounts(question.reached, task.goal)


def nearer(question: Question, task: Task) -> str:
    """Return by how much the action went nearer to the goal or away from it."""
    before, after = (float(pose.position_distance(p, task.goal)) for p in (question.pose, question.reached))
    change = 1e3 * (before - after)
    return f"{abs(change):.1f} mm {'nearer' if change >= 0 else 'farther'}"


def opinion(question: Question) -> str:
    """Return what the intent model wishes: how far, at what angle to the action's motion, and with what turn."""
    wish, went = ((end - question.pose)[pose.POSITION] for end in (question.predicted, question.reached))
    lengths = float(np.linalg.norm(wish)), float(np.linalg.norm(went))
    text = f"{1e3 * lengths[0]:.1f} mm"
    if min(lengths) > _NOTHING_M:
        cosine = float(np.clip(wish @ went / (lengths[0] * lengths[1]), -1.0, 1.0))
        text += f", {np.degrees(np.arccos(cosine)):.0f}° off it"
    turn = float(pose.rotation_distance(question.predicted, question.pose))
    return text + (f", turns {np.degrees(turn):.1f}°" if np.degrees(turn) >= 0.05 else "")


def choices(question: Question, task: Task) -> list[str]:
    """Return what each action's key would say, or why it cannot be said ("never right here")."""
    allowed = choosable(question, task)
    texts = []
    for action in range(len(allowed)):
        if not allowed[action]:
            texts.append("-")
            continue
        text = SHORT[action]
        if question.candidates is not None:
            ends = np.array([question.pose, question.candidates[action]])
            before, after = pose.position_distance(ends, task.goal)
            text += f" {1e3 * (after - before):+.1f}"
        texts.append(text)
    return texts


def choosable(question: Question, task: Task) -> np.ndarray:
    """Return which actions (A,) may be named as better; those that the task allows where the question does not say."""
    return legal_actions(task) if question.choosable is None else question.choosable


def help_lines(question: Question | None) -> list[str]:
    """Return what the keys do."""
    lines = list(_HELP)
    if suggests(question):
        lines[_BETTER : _BETTER + 2] = [
            "0-9 m  wrong, and this action would have been right: m is",
            "       the model's own (naming the action itself says right)",
        ]
    return lines


def suggests(question: Question | None) -> bool:
    """Return whether the model's own suggestion is one of the actions, as it is where actions are continuous."""
    return question is not None and question.candidates is not None and len(question.candidates) > COUNT


def verdict(right: bool | None) -> str:
    """Return an answer in a word."""
    return "skipped" if right is None else "right" if right else "wrong"


def told(answer: Answer) -> str:
    """Return an answer in a few words."""
    better = "" if answer.better is None else f": better {SHORT[answer.better]}"
    return verdict(answer.right) + better


def recalled(item: Earlier) -> str:
    """Return an earlier answer in a few words."""
    return f"answer {item.number}, {SHORT[item.action]}: {verdict(item.right)}"


def _amounts(one: Array, other: Array) -> str:
    moved, turned = float(pose.position_distance(one, other)), float(pose.rotation_distance(one, other))
    return f"{1e3 * moved:7.1f} mm {np.degrees(turned):6.1f}°"
