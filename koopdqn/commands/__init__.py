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
    from importlib import import_module

    from koopdqn.commands.configuration import Configuration
    from koopdqn.robot.rendering_backend import prepare_rendering

    prepare_rendering()
    result: CommandResult = import_module(f"koopdqn.commands.{command}").run(Configuration.load(config), folder)
    return result
