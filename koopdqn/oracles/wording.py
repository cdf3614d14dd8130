"""What is said to a person about a question: what the action did, what is left to do, and the answers."""

from typing import Final

import numpy as np

from koopdqn import pose
from koopdqn.oracles.base import Answer, Earlier, Question
from koopdqn.tasks.actions import COUNT, legal_actions
from koopdqn.tasks.task import Task

SHORT: Final = (
    "goal and turn",
    "goal",
    "turn",
    "goal and turn more",
    "+x",
    "-x",
    "+y",
    "-y",
    "+z",
    "-z",
)
"""Table 1's actions in a word or two, in its order."""
_NOTHING_M: Final = 1e-6


def moved(question: Question) -> str:
    """Return how far the action went, in position and in rotation."""
    return _amounts(
        float(pose.position_distance(question.reached, question.pose)),
        float(pose.rotation_distance(question.reached, question.pose)),
    )


def remaining(question: Question, task: Task) -> str:
    """Return how far the goal is after the action, in position and in rotation."""
    return _amounts(
        float(pose.position_distance(question.reached, task.goal)),
        float(pose.rotation_distance(question.reached, task.goal)),
    )


def nearer(question: Question, task: Task) -> str:
    """Return by how much the action went nearer to the goal or away from it."""
    before, after = (float(pose.position_distance(p, task.goal)) for p in (question.pose, question.reached))
    change = 1e3 * (before - after)
    return f"{abs(change):.1f} mm {'nearer' if change >= 0 else 'farther'}"


def opinion(question: Question) -> str:
    """Return how the intent model's wish differs from the action."""
    wish, went = ((end - question.pose)[pose.POSITION] for end in (question.predicted, question.reached))
    lengths = float(np.linalg.norm(wish)), float(np.linalg.norm(went))
    text = f"{1e3 * lengths[0]:.1f} mm"
    if min(lengths) > _NOTHING_M:
        cosine = float(np.clip(wish @ went / (lengths[0] * lengths[1]), -1.0, 1.0))
        text += f", {np.degrees(np.arccos(cosine)):.0f}° off this motion"
    turn = float(pose.rotation_distance(question.predicted, question.pose))
    return text + (f", turning {np.degrees(turn):.1f}°" if np.degrees(turn) >= 0.05 else "")


def choices(question: Question, task: Task) -> list[str]:
    """Return what each of the ten keys would say, or why it cannot be said ("never right here")."""
    allowed = choosable(question, task)
    texts = []
    for action in range(COUNT):
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
    """Return which actions (10,) may be named as better: those that the task allows and that do something."""
    legal = legal_actions(task)
    if question.candidates is None:
        return legal
    far = pose.position_distance(question.candidates, question.pose) > _NOTHING_M
    turned = pose.rotation_distance(question.candidates, question.pose) > _NOTHING_M
    return legal & (far | turned)


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


def _amounts(metres: float, radians: float) -> str:
    return f"{1e3 * metres:7.1f} mm {np.degrees(radians):6.1f}°"
