"""What the commands do with a composed config: one function each, from config and run folder to a result."""

from pathlib import Path
from typing import TYPE_CHECKING, Final

from koopdqn.app.hydra.application import CommandResult
from koopdqn.errors import BadInputError

if TYPE_CHECKING:
    from omegaconf import DictConfig

_COMMANDS: Final = {
    "demo": ("demonstrations.demo", ("demos", "intent_file")),
    "fit": ("fit.run", ("run", "intent_file")),
    "train": ("train.run", ()),
    "eval": ("eval.run", ("demos", "intent_file")),
    "correct": ("correct.run", ("demos", "intent_file")),
    "view": ("view.run", ("intent_file",)),
    "explain": ("explain.run", ("demos", "intent_file")),
    "compare": ("compare.run", ("demos", "intent_file")),
    "report": ("report.run", ("run", "demos", "intent_file")),
    "import": ("demonstrations.import_", ("run", "intent_file")),
    "inspect": ("inspection.inspect", ("run", "intent_file")),
    "export": ("demonstrations.export", ("intent_file",)),
    "stream": ("program.stream_path", ("demos", "intent_file")),
}
"""Where each command is, and the inputs of others that would change nothing here."""


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
    from koopdqn.untrusted import targets, trusting

    settings = Configuration.load(config)
    place, foreign = _COMMANDS[command]
    for key in foreign:
        value = getattr(settings.inputs, key)
        if value is not None:
            found = ", ".join(value) if isinstance(value, tuple) else str(value)
            takers = ", ".join(sorted(name for name, (_, others) in _COMMANDS.items() if key not in others))
            rule = f"must be left out, as koopdqn {command} does not take it"
            raise BadInputError(f"{key.removesuffix('_file')}: {rule}, found {found!r}; taken by: {takers}")
    # What the config names was named by the user: a run's record may name classes of koopdqn alone.
    named = [str(target).rpartition(".")[0] for _, target in targets(plain(config))]
    with warnings.catch_warnings(), trusting([*settings.inputs.trust_modules, *named]), threads(settings.train.threads):
        # What diverges is found and told where it matters; NumPy's own lines about it help nobody.
        if not sys.warnoptions:
            warnings.simplefilter("ignore", RuntimeWarning)
        looked_at = ("eval", "explain", "compare", "export", "stream", "view", "correct")
        if command in looked_at and settings.inputs.run is not None:
            settings = as_trained(with_task(settings, settings.inputs.run, keep=False), settings.inputs.run)
        elif command in ("fit", "train"):
            # These keep the demonstrations in their own folder.
            settings = with_task(settings, folder, keep=True)
        module, _, function = place.partition(".")
        result: CommandResult = getattr(import_module(f"{__name__}.{module}"), function)(settings, folder)
    return result
