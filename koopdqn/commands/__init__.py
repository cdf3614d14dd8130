"""What the commands do with a composed config: one function each, from config and run folder to a result."""

from pathlib import Path
from typing import TYPE_CHECKING

from koopdqn.errors import unknown_name
from koopdqn.result import CommandResult

if TYPE_CHECKING:
    from omegaconf import DictConfig

COMMANDS = ("demo", "fit", "train", "eval")


def run(command: str, config: "DictConfig", folder: Path) -> CommandResult:
    """Run a command on a composed config in its run folder.

    Raises:
        BadInputError: the config, or a file it names, breaks a rule.
        WorkFailedError: the work itself failed.
    """
    if command not in COMMANDS:
        raise unknown_name("command", command, COMMANDS)
    import logging
    from importlib import import_module

    from koopdqn.robot.rendering_backend import prepare_rendering

    # MuJoCo chooses its backend at its first import, and dm_control and OpenGL announce the choice at length.
    prepare_rendering()
    for chatty in ("absl", "OpenGL"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
    from koopdqn.commands.configuration import Configuration

    result: CommandResult = import_module(f"koopdqn.commands.{command}").run(Configuration.load(config), folder)
    return result
