"""What the commands do with a composed config: one function each, from config and run folder to a result."""

from pathlib import Path
from typing import TYPE_CHECKING

from koopdqn.app.command_table import COMMANDS
from koopdqn.app.hydra.application import CommandResult
from koopdqn.errors import BadInputError

if TYPE_CHECKING:
    from omegaconf import DictConfig


def run(command: str, config: "DictConfig", folder: Path) -> CommandResult:
    """Run a command on a composed config in its run folder.

    Raises:
        BadInputError: the config, or a file it names, breaks a rule.
        WorkFailedError: the work itself failed.
    """
    import logging
    import sys
    import warnings
    from importlib import import_module

    # They announce the rendering backend at length.
    for chatty in ("absl", "OpenGL"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
    from koopdqn.app.commands.configuration import Configuration
    from koopdqn.app.commands.demonstrated import with_task
    from koopdqn.app.commands.trained import as_trained
    from koopdqn.settings import plain
    from koopdqn.threads import threads
    from koopdqn.untrusted import modules_named, trusting

    settings = Configuration.load(config)
    what = COMMANDS[command]
    for key, taken in what.inputs.items():
        value = getattr(settings.inputs, key)
        if value is not None and not taken:
            found = ", ".join(value) if isinstance(value, tuple) else str(value)
            takers = ", ".join(sorted(name for name, other in COMMANDS.items() if other.inputs[key]))
            rule = f"must be left out, as koopdqn {command} does not take it"
            raise BadInputError(f"{key.removesuffix('_file')}: {rule}, found {found!r}; taken by: {takers}")
    # What the config names was named by the user: a run's record may name classes of koopdqn alone.
    named = modules_named(plain(config))
    with warnings.catch_warnings(), trusting([*settings.inputs.trust_modules, *named]), threads(settings.train.threads):
        # What diverges is found and told where it matters; NumPy's own lines about it help nobody.
        if not sys.warnoptions:
            warnings.simplefilter("ignore", RuntimeWarning)
        if what.looks_at and settings.inputs.run is not None:
            settings = as_trained(with_task(settings, settings.inputs.run, keep=False), settings.inputs.run)
        elif what.demos == "learn":
            settings = with_task(settings, folder, keep=True)
        module, _, function = what.function.partition(".")
        result: CommandResult = getattr(import_module(f"{__name__}.{module}"), function)(settings, folder)
    return result
