"""What the commands do with a composed config: one function each, from config and run folder to a result."""

from pathlib import Path
from typing import TYPE_CHECKING

from koopdqn.app.result import CommandResult
from koopdqn.errors import BadInputError, unknown_name

if TYPE_CHECKING:
    from omegaconf import DictConfig

# Inputs of other commands; given to this one they would change nothing.
_FOREIGN_INPUTS = {
    "demo": ("demos", "intent_file"),
    "fit": ("run", "intent_file"),
    "eval": ("demos", "intent_file"),
    "report": ("run", "demos", "intent_file"),
    "import": ("run", "intent_file"),
    "export": ("run", "intent_file"),
}
COMMANDS = ("demo", "fit", "train", "eval", "report", "import", "export")
# Where a command's name cannot be a module's.
_MODULES = {"import": "import_demonstrations", "export": "export_demonstrations"}


def run(command: str, config: "DictConfig", folder: Path) -> CommandResult:
    """Run a command on a composed config in its run folder.

    Raises:
        BadInputError: the config, or a file it names, breaks a rule.
        WorkFailedError: the work itself failed.
    """
    if command not in COMMANDS:
        raise unknown_name("command", command, COMMANDS)
    import logging
    import sys
    import warnings
    from importlib import import_module

    # They announce the rendering backend at length.
    for chatty in ("absl", "OpenGL"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
    from koopdqn.app.commands.configuration import Configuration
    from koopdqn.app.commands.stages import with_task
    from koopdqn.settings import plain
    from koopdqn.threads import threads
    from koopdqn.untrusted import targets, trusting

    settings = Configuration.load(config)
    for key in _FOREIGN_INPUTS.get(command, ()):
        value = getattr(settings.inputs, key)
        if value is not None:
            name = "intent" if key == "intent_file" else key
            found = ", ".join(value) if isinstance(value, tuple) else str(value)
            raise BadInputError(f"{name}: koopdqn {command} reads no such file or folder, found {found!r}")
    # What the config names was named by the user: a run's record may name classes of koopdqn alone.
    named = [str(target).rpartition(".")[0] for _, target in targets(plain(config))]
    with warnings.catch_warnings(), trusting([*settings.inputs.trust_modules, *named]), threads(settings.train.threads):
        # What diverges is found and told where it matters; NumPy's own lines about it help nobody.
        if not sys.warnoptions:
            warnings.simplefilter("ignore", RuntimeWarning)
        if command in ("fit", "train", "eval"):
            # The run that eval measures holds its demonstrations; the others keep them in their own folder.
            holds = (settings.inputs.run or folder) if command == "eval" else folder
            settings = with_task(settings, holds, keep=command != "eval")
        result: CommandResult = import_module(f"koopdqn.app.commands.{_MODULES.get(command, command)}").run(
            settings, folder
        )
    return result
