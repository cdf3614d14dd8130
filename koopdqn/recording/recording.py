"""A recording in a run folder: keys in, demonstrations on disk."""

from pathlib import Path

from koopdqn.config.messages import shown
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.hdf5 import read_hdf5, write_hdf5
from koopdqn.errors import BadInputError
from koopdqn.feedback.journal import JournalFile
from koopdqn.recording.log import LOG, logged_keys, session_line
from koopdqn.recording.recorder import Recorder, Reply
from koopdqn.recording.schema import KeyLine
from koopdqn.recording.settings import DemoSettings
from koopdqn.workcell import Workcell


class Recording:
    """A recorder whose every key and every demonstration is on disk before the next key. Close it.

    Attributes:
        recorder: what is recorded.
    """

    def __init__(self, workcell: Workcell, settings: DemoSettings, seed: int, folder: Path, name: str) -> None:
        """Begin in a run folder, or go on with the recording that it holds.

        Args:
            workcell: task, arm and scene.
            settings: how keys move the arm and how paths are played.
            seed: by which starts are drawn.
            folder: the run folder.
            name: of the file of demonstrations in it.

        Raises:
            BadInputError: what the folder holds is damaged, or is of another recording.
        """
        self.recorder = Recorder(workcell, settings, seed)
        self._workcell = workcell
        self._path = folder / name
        session = session_line(workcell, settings, seed)
        log = folder / LOG
        keys = logged_keys(log, session)
        before = self.demonstrations()
        for number, key in enumerate(keys, start=2):
            before = self.demonstrations()
            reply = self.recorder.press(key, sure=True)
            if not reply.changed:
                raise BadInputError(f"{log}, line {number}: {shown(key)} must do what it did then, found: {reply.text}")
        self._check_file(before)
        begun = log.exists() and b"\n" in log.read_bytes()
        self._log = JournalFile(log)
        if not begun:
            self._log.append(session)
        self._written = -1
        self._write()

    def demonstrations(self) -> Demonstrations | None:
        """Return what is kept so far, or None if nothing is."""
        kept = self.recorder.state.kept
        return Demonstrations(self._workcell.task.name, self._workcell.arm.name, kept) if kept else None

    def press(self, key: str) -> Reply:
        """Do what a key says; what it changed is on disk when this returns."""
        reply = self.recorder.press(key)
        if reply.changed:
            self._log.append(KeyLine(kind="key", key=key))
            self._write()
        return reply

    def close(self) -> None:
        """Close the log."""
        self._log.close()

    def _write(self) -> None:
        count = len(self.recorder.state.kept)
        if count == self._written:
            return
        kept = self.demonstrations()
        if kept is not None:
            write_hdf5(self._path, kept)
        else:
            # Its one demonstration was taken back; the log holds it.
            self._path.unlink(missing_ok=True)
        self._written = count

    def _check_file(self, before: Demonstrations | None) -> None:
        """Raise unless the file of demonstrations is that of the log, or of the log ``before`` its last key."""
        if not self._path.exists():
            return
        found, kept = read_hdf5(self._path), self.demonstrations()
        if found.digest() not in [item.digest() for item in (kept, before) if item is not None]:
            recorded = len(self.recorder.state.kept)
            raise BadInputError(
                f"run: {self._path} must hold the {recorded} demonstrations that {LOG} beside it records,"
                f" found {len(found)} that differ"
            )
