"""The run folder: it must be new or empty, so that nothing a user made is overwritten."""

import contextlib
import itertools
import os
import shlex
import shutil
from pathlib import Path
from typing import Final

from koopdqn.errors import BadInputError
from koopdqn.run_folder import BEGUN, RECORD, check_plain, locked

# Hydra writes it before it looks whether the first job's config can be composed, and writes it anew.
_OF_A_SWEEP: Final = "multirun.yaml"

_held: Final = contextlib.ExitStack()
# Folders of default names that this process made, each with those above it that were not there either.
_made: list[list[Path]] = []


def register_resolver(*, check: bool) -> None:
    """Register what conf/ puts around the run folder, and ``${per_task:NAME,USUAL,{OTHER: VALUE}}``.

    ``${new_folder:PATH}`` gives PATH back, ``${free_folder:PATH}``, of the folder's default name, may number it.
    Hydra asks for the run folder before it writes there, so that this is the moment to look: OmegaConf
    keeps what a resolver first returned, and the later requests of the same run (when the folder has
    begun to fill) see that. Only with ``check`` is a folder that holds something refused, and a free one taken for
    good: a config that is only shown needs neither.
    """
    from omegaconf import OmegaConf

    # Appendix 7.1 gives some tasks their own.
    OmegaConf.register_new_resolver("per_task", lambda name, usual, others: others.get(name, usual), replace=True)
    for name, resolver in (("new_folder", _checked), ("free_folder", _taken)):
        OmegaConf.register_new_resolver(name, resolver if check else str, replace=True, use_cache=True)


def ensure_resolver() -> None:
    """Register the resolvers for showing alone, unless a command has registered them."""
    from omegaconf import OmegaConf

    if not OmegaConf.has_resolver("new_folder"):
        register_resolver(check=False)


def require_new(folder: Path, ignore: str = "") -> None:
    """Raise BadInputError unless a run folder is absent, empty, or holds hidden files or what a refused sweep leaves.

    The file ``ignore`` may be there too, such as the log that Hydra opens first.
    """
    if not folder.is_dir():
        return
    names = sorted(entry.name for entry in folder.iterdir() if not entry.name.startswith(".") and entry.name != ignore)
    if names and names != [_OF_A_SWEEP]:
        listed = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
        hint = f"; koopdqn train run={shlex.quote(str(folder))} goes on with it" if BEGUN in names else ""
        raise BadInputError(
            f"out: must name a new or an empty folder, found {str(folder)!r}, which holds {listed}{hint}"
        )


def require_writable(folder: Path) -> None:
    """Make a folder and its parents; raise BadInputError if that fails or no files can be made in it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise BadInputError(f"out: must name a folder that can be written, found {str(folder)!r} ({reason})") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise BadInputError(f"out: must name a folder that can be written, found {str(folder)!r} (no permission)")


def _taken(path: object) -> str:
    """Make a folder that is nobody else's yet, numbered where the name is taken: the clock tells seconds only."""
    wanted = Path(str(path))
    # The name holds the task's, which nothing has checked yet.
    if ".." in wanted.parts or not str(path).isprintable():
        raise BadInputError(f"task.name: must be a name that a folder can have, found one that makes {str(path)!r}")
    above = [each for each in wanted.parents if not each.exists()]
    require_writable(wanted.parent)
    for number in itertools.count(1):
        folder = wanted if number == 1 else wanted.with_name(f"{wanted.name}-{number}")
        with contextlib.suppress(FileExistsError):
            # of two commands started at once only one succeeds here
            folder.mkdir()
            _made.append([folder, *above])
            break
    return str(folder)


def _checked(path: object) -> str:
    text = str(path)
    if path is None or not text.strip():
        raise BadInputError(f"out: must name a folder, found {path!r}")
    require_new(Path(text))
    record = Path(text) / RECORD.parent
    # Hydra writes there, through links too.
    if record.is_symlink() or (record.exists() and not record.is_dir()):
        raise BadInputError(f"out: must name a new or an empty folder, found {text!r}, whose .hydra is no folder")
    if record.is_dir():
        check_plain(record)
    require_writable(Path(text))
    # Before Hydra writes there: of two commands started at once the second must not touch the first one's record.
    _held.enter_context(locked(Path(text)))
    return text


def release_taken(*, refused: bool) -> None:
    """Unlock the run folders that the resolver has taken.

    Of a command that was ``refused`` those of default names are removed where nothing but Hydra's record lies in them.
    """
    _held.close()
    while _made:
        folder, *above = _made.pop()
        if not refused or not folder.is_dir() or {each.name for each in folder.iterdir()} - {RECORD.parent.name}:
            continue
        shutil.rmtree(folder)
        with contextlib.suppress(OSError):
            # Another command may have begun there.
            for each in above:
                each.rmdir()
