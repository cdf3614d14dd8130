"""What journals say, in figures: answers by teacher, and how far teachers agree."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations
from statistics import median

from koopdqn.feedback.records import Record, Records
from koopdqn.feedback.schema import AgreementSummary, FeedbackSummary, TeacherSummary


def summarised(journals: Sequence[Records]) -> FeedbackSummary:
    """Return the figures of some journals together."""
    items = [item for records in journals for item in records.items]
    standing = [item for records in journals for item in records.standing]
    by_teacher: dict[str, list[Record]] = defaultdict(list)
    for item in standing:
        by_teacher[item.line.source].append(item)
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


def _teacher(name: str, items: Iterable[Record]) -> TeacherSummary:
    lines = [item.line for item in items]
    return TeacherSummary(
        name=name,
        answers=len(lines),
        right=sum(line.right is True for line in lines),
        wrong=sum(line.right is False for line in lines),
        skipped=sum(line.right is None for line in lines),
        better=sum(line.better is not None for line in lines),
        median_seconds=median(line.seconds for line in lines),
    )
