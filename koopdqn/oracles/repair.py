"""Repairing journals: answers changed afterwards, journals of several teachers merged, and their agreement."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import chain, combinations
from pathlib import Path
from statistics import median

from pydantic import Field

from koopdqn.errors import BadInputError
from koopdqn.files import atomic_path
from koopdqn.oracles.journal import (
    AnswerLine,
    DropLine,
    EditLine,
    JournalFile,
    OpinionLine,
    Record,
    Records,
    copy_answers,
    read_records,
)
from koopdqn.settings import Fraction, Name, NonNegative, NonNegativeInt, ReportModel
from koopdqn.tasks.actions import SUGGESTED


class TeacherSummary(ReportModel):
    """What one teacher answered; withdrawn answers are left out."""

    name: Name = Field(description="who answered")
    answers: NonNegativeInt = Field(description="answers given")
    right: NonNegativeInt = Field(description="of these, right")
    wrong: NonNegativeInt = Field(description="of these, wrong")
    skipped: NonNegativeInt = Field(description="of these, skipped")
    better: NonNegativeInt = Field(description="of these, how many named the action that would have been right")
    median_seconds: NonNegative = Field(description="median time of an answer [s]")


class AgreementSummary(ReportModel):
    """How far two teachers agree on the questions that both answered."""

    one: Name = Field(description="one teacher")
    other: Name = Field(description="the other")
    questions: NonNegativeInt = Field(description="questions that both answered")
    same: NonNegativeInt = Field(description="of these, how many alike")
    share: Fraction = Field(description="their share")


class FeedbackSummary(ReportModel):
    """What ``koopdqn feedback show --json`` prints."""

    answers: NonNegativeInt = Field(description="answers in the journals")
    withdrawn: NonNegativeInt = Field(description="of these, withdrawn")
    edited: NonNegativeInt = Field(description="of these, changed afterwards")
    teachers: list[TeacherSummary] = Field(description="by teacher")
    agreement: list[AgreementSummary] = Field(description="by pair of teachers who answered the same questions")


UNNAMED = "editor"
"""Who changes an answer, where nobody says."""

_ANSWERS = {"y": True, "yes": True, "right": True, "n": False, "no": False, "wrong": False, "s": None, "skip": None}


def parse_answer(text: str, action: int, *, continuous: bool = False) -> tuple[bool | None, int | None]:
    """Return what a text answers to a question about an action: right, and the better action.

    It is right, wrong, skip, an action of Table 1 or, where actions are continuous, m: the intent model's suggestion.

    Raises:
        BadInputError: the text is none of these.
    """
    if continuous and text.lower() == "m":
        return action == SUGGESTED, SUGGESTED
    if text.isascii() and len(text) == 1 and text.isdecimal():
        return int(text) == action, int(text)
    if text.lower() not in _ANSWERS:
        suggestion = ", or m (the model's suggestion)" if continuous else ""
        raise BadInputError(
            f"answer: must be right, wrong, skip or a better action from 0 to 9{suggestion}, found {text!r}"
        )
    return _ANSWERS[text.lower()], None


def edit(path: Path, number: int, text: str, teacher: str | None, learned: int, *, drop_later: bool) -> Record:
    """Change an answer of a journal by a new line in it, and return the answer as it is now.

    The text is the new answer as :func:`parse_answer` reads it, the teacher who changes it or None for
    :data:`UNNAMED`. The run in the journal's folder has learned from the first ``learned`` answers. With ``drop_later``
    all later ones no longer count.

    Raises:
        BadInputError: the journal is damaged or cannot be written, or has no such answer that stands.
    """
    records = read_records(path)
    if not records.items:
        raise BadInputError(f"number: must be that of an answer, found {number}, and a journal without answers")
    if not 0 <= number < len(records.items):
        raise BadInputError(f"number: must be that of an answer, 0 to {len(records.items) - 1}, found {number}")
    # Dropping what is later drops the withdrawal too.
    if records.items[number].withdrawn and not drop_later:
        raise BadInputError(f"number: must be that of an answer that stands, found {number}, which was withdrawn")
    line = records.items[number].line
    if _passed_by_undo(records, number) and not drop_later:
        raise BadInputError(
            f"number: must not be that of a skipped question before an answer was withdrawn, found {number}: what was"
            " withdrawn would be another; --drop-later takes back all that follows"
        )
    # With Table 1's ten actions there is no suggestion to ask about; with continuous ones it is asked about first.
    continuous = any(SUGGESTED in (each.line.action, each.line.better) for each in records.items)
    right, better = parse_answer(text, line.action, continuous=continuous)
    if teacher is not None and (not teacher.strip() or not teacher.isprintable()):
        raise BadInputError(f"--teacher: must be a name on one line, found {teacher!r}")
    source, late = teacher or UNNAMED, number < learned
    with closing(JournalFile(path)) as file:
        file.append(EditLine(kind="edit", number=number, right=right, better=better, source=source, learned=late))
        if drop_later:
            file.append(DropLine(kind="drop", number=number))
    return read_records(path).items[number]


def _passed_by_undo(records: Records, number: int) -> bool:
    """Return whether an answer was withdrawn after a question was skipped: it would count if it were answered.

    One may wait for the next answer, which will withdraw it.
    """
    skipped = records.items[number].line.right is None
    return skipped and (records.pending > 0 or any(item.undo for item in records.items[number + 1 :]))


@dataclass(frozen=True)
class Merged:
    """The answers of a merged journal, others' opinions on them, changes by the majority, and answers left out."""

    answers: int
    opinions: int
    changed: int
    left_out: int


def merge(paths: Sequence[Path], out: Path) -> Merged:
    """Write a journal that holds the first one's answers and what the others say to the same questions.

    Where most teachers answer otherwise than the first, their answer stands, as an edit; a tie leaves the first. Each
    teacher has one voice, however many journals hold it.
    Answers to other questions belong to another course of training and are left out.

    Raises:
        BadInputError: fewer than two journals are given, one is damaged, or ``out`` exists.
    """
    if len(paths) < 2:
        raise BadInputError(f"journals: must be 2 or more to be merged, found {len(paths)}")
    if out.exists():
        raise BadInputError(f"--out: must name a new file, found one: {out}")
    first, *others = [read_records(path) for path in paths]
    found, left_out = _opinions(first, others)
    edits = [
        edit
        for number, said in found.items()
        if not (_passed_by_undo(first, number) or first.items[number].withdrawn)
        and (edit := _by_majority(first.items[number], said)) is not None
    ]
    # Whoever is overruled keeps their voice.
    overruled = [_opinion(item) for edit in edits if (item := first.items[edit.number]).line.source != edit.source]
    with atomic_path(out) as temporary:
        copy_answers(paths[0], temporary)
        with closing(JournalFile(temporary)) as file:
            for line in [*chain.from_iterable(found.values()), *overruled, *edits]:
                file.append(line)
    return Merged(len(first.items), sum(map(len, found.values())), len(edits), left_out)


def _opinions(first: Records, others: Sequence[Records]) -> tuple[dict[int, list[OpinionLine]], int]:
    """Return what other journals say to the first one's questions by number, and how many answers are to none."""
    numbers = {_key(item): item.line.number for item in first.items}
    found: dict[int, list[OpinionLine]] = {}
    left_out = 0
    for item in (item for records in others for item in records.standing):
        number = numbers.get(_key(item))
        if number is None:
            left_out += 1
            continue
        own = first.items[number].line.source
        said = [each.model_copy(update={"number": number}) for each in (*item.opinions, _opinion(item))]
        if others_said := [each for each in said if each.source != own]:
            found.setdefault(number, []).extend(others_said)
    return dict(sorted(found.items())), left_out


def _opinion(item: Record) -> OpinionLine:
    line = item.line
    return OpinionLine(kind="opinion", number=line.number, right=line.right, better=line.better, source=line.source)


def _by_majority(item: Record, said: Sequence[OpinionLine]) -> EditLine | None:
    # A teacher has one voice: the latest, but for the one whose answer stands.
    voices_of = {voice.source: voice.right for voice in (*item.opinions, *said)}
    every = {**voices_of, item.line.source: item.line.right}
    votes = Counter(right for right in every.values() if right is not None)
    winner = votes[True] > votes[False]
    if votes[True] == votes[False] or winner == item.line.right:
        return None
    voices = [voice for voice in said if voice.right == winner]
    source = voices[0].source if voices else item.line.source
    better = next((voice.better for voice in voices if voice.better is not None), None)
    return EditLine(kind="edit", number=item.line.number, right=winner, better=better, source=source, learned=False)


def _key(item: Record) -> tuple[object, ...]:
    return item.line.episode, item.line.step, item.line.action, *item.line.pose


def summarise(journals: Sequence[Records]) -> FeedbackSummary:
    """Return the figures of some journals together."""
    items = [item for records in journals for item in records.items]
    standing = [item for item in items if not item.withdrawn]
    by_teacher: dict[str, list[AnswerLine]] = defaultdict(list)
    for item in standing:
        by_teacher[item.line.source].append(item.line)
    return FeedbackSummary(
        answers=len(items),
        withdrawn=len(items) - len(standing),
        edited=sum(item.edited for item in items),
        teachers=[_teacher(name, by_teacher[name]) for name in sorted(by_teacher)],
        agreement=agreement(journals),
    )


def agreement(journals: Sequence[Records]) -> list[AgreementSummary]:
    """Return how far every two teachers agree on the questions that both answered.

    A question is the same where pose and action are; of a teacher's answers to it the latest counts, and skipping
    is no answer.
    """
    said: dict[tuple[object, ...], dict[str, bool]] = defaultdict(dict)
    for records in journals:
        for item in records.standing:
            for source, right in _voices(item):
                if right is not None:
                    said[(*item.line.pose, item.line.action)][source] = right
    both: dict[tuple[str, str], list[bool]] = defaultdict(list)
    for voices in said.values():
        for one, other in combinations(sorted(voices), 2):
            both[one, other].append(voices[one] == voices[other])
    return [
        AgreementSummary(one=one, other=other, questions=len(same), same=sum(same), share=sum(same) / len(same))
        for (one, other), same in sorted(both.items())
    ]


def _voices(item: Record) -> Iterator[tuple[str, bool | None]]:
    for opinion in item.opinions:
        yield opinion.source, opinion.right
    yield item.line.source, item.line.right


def _teacher(name: str, lines: Sequence[AnswerLine]) -> TeacherSummary:
    return TeacherSummary(
        name=name,
        answers=len(lines),
        right=sum(line.right is True for line in lines),
        wrong=sum(line.right is False for line in lines),
        skipped=sum(line.right is None for line in lines),
        better=sum(line.better is not None for line in lines),
        median_seconds=median(line.seconds for line in lines),
    )
