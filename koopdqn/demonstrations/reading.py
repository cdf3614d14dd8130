"""Demonstrations from whatever files the user names, one, several or a glob."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from koopdqn import console
from koopdqn.demonstrations.dataset import Demonstration, Demonstrations, Placement
from koopdqn.demonstrations.recordings.load import Loaded, load
from koopdqn.demonstrations.recordings.recording import NOTHING, ImportSettings
from koopdqn.errors import BadInputError
from koopdqn.robot.arm import Arm
from koopdqn.settings import shown, typed

Sources = str | Path | Sequence[str | Path]
"""Files: a path or a glob, or several."""


def files_of(sources: Sources) -> list[Path]:
    """Return the files of sources, paths or globs, in the given order; those of a glob in natural order.

    Raises:
        BadInputError: there is none, a glob matches nothing, or a file is named twice.
    """
    if isinstance(sources, str | Path):
        sources = (sources,)
    sources = list(sources) if isinstance(sources, Iterable) else sources
    if not isinstance(sources, list) or not all(isinstance(each, str | Path) for each in sources):
        raise BadInputError(f"demos: must be a path or a glob, or several, found {shown(sources)}")
    if not sources:
        raise BadInputError("demos: must name a file at least, found none")
    try:
        found = _found(sources)
    # A pattern that is none, a home of nobody, a link to itself.
    except (RuntimeError, ValueError, OSError) as error:
        raise BadInputError(f"demos: must name files, found {', '.join(map(str, sources))}: {error}") from error
    spelled: dict[Path, Path] = {}
    for path, place in found:
        # In whatever spelling, or through a link.
        before = spelled.setdefault(place, path)
        if before is not path:
            other = "" if before == path else f", as {before} too"
            raise BadInputError(f"demos: must name every file once, found twice {path}{other}")
    return [path for path, _ in found]


def _found(sources: Iterable[str | Path]) -> list[tuple[Path, Path]]:
    """Return the files of sources, and where each lies, whatever it is called."""
    found: list[Path] = []
    for source in sources:
        named = str(Path(source).expanduser())
        # A file may have a bracket or an asterisk in its name.
        path = Path(named)
        if path.exists() or not any(sign in named for sign in "*?["):
            paths = [path]
        else:
            folder = Path(path.anchor or ".")
            paths = sorted(folder.glob(str(path.relative_to(path.anchor))), key=_natural)
            if not paths:
                raise BadInputError(f"demos: must name files, found none that match {source}")
        found += paths
    return [(path, path.resolve()) for path in found]


def read_files(sources: Sources, declared: ImportSettings, arm: Arm | None) -> list[Loaded]:
    """Return what each of the files holds that sources name (:func:`files_of`).

    Raises:
        BadInputError: a file is missing, damaged, or something must be declared, or is and no file needs it.
    """
    read = [load(path, declared, arm) for path in files_of(sources)]
    own = [each for each in read if each.own] if declared.given() else []
    keys = ", ".join(f"import.{key}" for key in declared.given())
    if own and len(own) == len(read):
        raise BadInputError(
            f"{keys}: must be left out for {own[0].path}, which is read as it stands, being {own[0].kind}"
        )
    for each in own:
        console.note(f"{each.path}: read as it stands, being {each.kind}; {keys} without effect on it")
    return read


@typed
def read_demonstrations(
    sources: Sources,
    task: str,
    arm: str | Arm,
    any_task: bool = False,
    declared: ImportSettings = NOTHING,
) -> Demonstrations:
    """Return the demonstrations of all files that sources name (:func:`files_of`), one file after the other.

    What files of others were recognised as is told on standard error.

    Args:
        sources: a path or a glob, or several.
        task: name of the task they are to be of; most files do not say.
        arm: the arm, which most files do not name either; its name alone will do but for recordings of joints.
        any_task: whether files of other tasks will do.
        declared: what files of others do not say.

    Raises:
        BadInputError: a file is missing, damaged or of another task, or something must be declared.
    """
    robot = None if isinstance(arm, str) else arm
    read = read_files(sources, declared, robot)
    for each in read:
        if not each.own:
            console.note(f"{each.path}: {each.kind}; {'; '.join(each.reasons)}")
        if len(each.motions) > 1 and declared.cut is None:
            console.warn(
                f"{each.path} holds {len(each.motions)} motions, taken as one demonstration; import.cut=true cuts them,"
                " import.cut=false says that they are one"
            )
    return together(read, task, arm if isinstance(arm, str) else arm.name, any_task, bool(declared.cut))


def together(read: Sequence[Loaded], task: str, arm: str, any_task: bool, cut: bool) -> Demonstrations:
    """Return the demonstrations of files that were read, cut into motions if that is wanted.

    Raises:
        BadInputError: a file is of another task, or files were moved in different ways.
    """
    items: list[Demonstration] = []
    placements: dict[str, Placement | None] = {}
    for each in read:
        if not any_task and each.task not in (None, task):
            raise BadInputError(f"demos {each.path}: must be of task {task}, found task {each.task}")
        items += each.parts(cut)
        arm = each.arm or arm
        placements["none" if each.placement is None else str(each.placement)] = each.placement
    if len(placements) > 1:
        raise BadInputError(f"demos: all files must have been moved alike, found {' and '.join(sorted(placements))}")
    return Demonstrations(task, arm, items, placement=next(iter(placements.values())))


def _natural(path: Path) -> list[tuple[int, str]]:
    """Return a sort key that puts demo_9 before demo_10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", str(path))]
