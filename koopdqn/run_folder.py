"""A run folder: one process works in it at a time, and it holds files and folders of its own only.

The names stand here of those files that more than one module knows; docs/files.md lists them all.
"""

import errno
import fcntl
import os
import socket
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from koopdqn.errors import BadInputError

RUNS: Final = Path("runs")
"""Where run folders lie unless ``out=`` names another place."""
RECORD: Final = Path(".hydra") / "overrides.yaml"
"""Where Hydra writes what a run was begun with."""
LOCK: Final = ".lock"
"""The file that is locked while a process works in a folder."""
DEMONSTRATIONS: Final = "demos.hdf5"
INTENT: Final = "intent.npz"
FIT: Final = "fit.json"
FIT_PICTURE: Final = "fit.png"
BEGUN: Final = "begun.json"
"""What a training that was stopped must find unchanged."""
JOURNAL: Final = "feedback.jsonl"
CHECKPOINT: Final = Path("checkpoints") / "latest.safetensors"
POLICY: Final = "policy.safetensors"
TRAINING: Final = "train.json"
TRAINING_PICTURE: Final = "train.png"
EVALUATION: Final = "eval.json"

_MOST_ENTRIES: Final = 100_000
_held: set[Path] = set()


def newest_trained_run() -> Path:
    """Return the folder of the newest finished training run below ``runs/``.

    Raises:
        BadInputError: there is none.
    """
    finished = [path for path in RUNS.rglob(TRAINING) if (path.parent / POLICY).is_file()]
    if not finished:
        raise BadInputError("run: must name a trained run, found none given and none below runs/; train one first")
    return max(finished, key=lambda path: path.stat().st_mtime_ns).parent


def check_plain(folder: Path) -> None:
    """Raise unless a folder holds, at any depth, nothing but files and folders: no links, pipes or devices.

    A link would lead reading and writing out of the folder. The folder itself may be reached by one.

    Raises:
        BadInputError: it holds something else, or more than 100,000 entries.
    """
    waiting, count = [folder], 0
    while waiting:
        with os.scandir(waiting.pop()) as entries:
            for entry in entries:
                count += 1
                if count > _MOST_ENTRIES:
                    raise BadInputError(f"run folder {folder} must hold at most {_MOST_ENTRIES} files, found more")
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(Path(entry.path))
                elif not entry.is_file(follow_symlinks=False):
                    kind = "a link" if entry.is_symlink() else "something else"
                    name = os.path.relpath(entry.path, folder)
                    raise BadInputError(f"run folder {folder} must hold files and folders only, found {kind}: {name}")


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other processes from working in a folder during the block; within one process blocks may nest.

    The lock ends with the process, in whatever way that ends.

    Raises:
        BadInputError: another process works in it, or no file can be made there.
    """
    key = folder.resolve()
    if key in _held:
        yield
        return
    file = _locked_file(folder, key / LOCK)
    _held.add(key)
    try:
        yield
    finally:
        _held.remove(key)
        with suppress(OSError):
            (key / LOCK).unlink()
        os.close(file)


def _locked_file(folder: Path, path: Path) -> int:
    while True:
        try:
            file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        except OSError as error:
            raise BadInputError(f"run folder {folder} must be writable, the system says: {error.strerror}") from error
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            who = os.read(file, 100).decode(errors="replace").strip()
            os.close(file)
            if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
                raise BadInputError(
                    f"run folder {folder} must be free, found it in use by {who or 'another process'}"
                ) from error
            raise BadInputError(f"run folder {folder} cannot be locked, the system says: {error.strerror}") from error
        # Whoever held it before may have removed the file meanwhile.
        with suppress(OSError):
            if os.path.samestat(os.fstat(file), path.lstat()):
                break
        os.close(file)
    os.ftruncate(file, 0)
    os.write(file, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
    return file


def open_own(path: Path, flags: int) -> int:
    """Return a descriptor of a file that is written in place, made if it is missing.

    Raises:
        OSError: the system refuses, or the file is a link or no ordinary file, or has a second name elsewhere.
    """
    file = os.open(path, flags | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
    found = os.fstat(file)
    if not stat.S_ISREG(found.st_mode) or found.st_nlink != 1:
        os.close(file)
        raise OSError(errno.EMLINK, "it must be a file of one name, found a link or something else", str(path))
    return file
