"""The command line: parse, compose the config, call one function, print."""

import atexit
import contextlib
import gc
import sys
from collections.abc import Mapping, Sequence
from inspect import Parameter, Signature
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import typer

from koopdqn import __version__, console
from koopdqn.app.command_table import COMMANDS, Command
from koopdqn.app.exit_status import guard, let_go_of_closed_streams, open_missing_streams
from koopdqn.app.feedback import Debug, feedback_app
from koopdqn.errors import BadInputError

_YOUNG: Final = 50_000
"""How many new objects Python lets come before it looks for circles among them, while a command runs."""

app = typer.Typer(
    name="koopdqn",
    help="Teach a robot arm the path a person would choose.",
    epilog="Begin with [bold]koopdqn train task=shelf[/]; it needs nothing else.",
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


Shown = Literal["job", "hydra", "all"]
Info = Literal["all", "config", "defaults", "defaults-tree", "plugins", "searchpath"]


def _complete(ctx: typer.Context, incomplete: str) -> list[str]:
    from koopdqn.app.hydra.completion import complete

    return complete(ctx.params.get("overrides") or [], incomplete, ctx.params.get("config_dir"))


def _parameter(name: str, kind: object, default: object, declared: object) -> Parameter:
    return Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, declared])


def _hydra(flag: str, short: str | None, kind: object, text: str, metavar: str | None = None) -> Parameter:
    """Return an option that is Hydra's own; it is passed on."""
    names = [flag, short] if short else [flag]
    option = typer.Option(*names, metavar=metavar, help=text, rich_help_panel="Hydra")
    return _parameter(flag.removeprefix("--").replace("-", "_"), kind, False if kind is bool else None, option)


_OVERRIDES: Final = typer.Argument(
    metavar="OVERRIDE",
    help="Config overrides: [cyan]group=option[/] or [cyan]key=value[/]; groups are task, person, intent, trust, "
    "oracle, agent, robot, actions, preset. [cyan]out=DIR[/] names the run folder, [cyan]seed=N[/] fixes everything.",
    autocompletion=_complete,
    show_default=False,
)
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON to standard output and nothing else.")]
_OWN_OPTIONS: Final = (
    _parameter("overrides", list[str] | None, None, _OVERRIDES),
    Parameter("as_json", Parameter.KEYWORD_ONLY, default=False, annotation=AsJson),
    Parameter("debug", Parameter.KEYWORD_ONLY, default=False, annotation=Debug),
)
_HYDRA_OPTIONS: Final = (
    _hydra("--multirun", "-m", bool, "Sweep over comma-separated values."),
    _hydra("--run", "-r", bool, "Run one job (the default)."),
    _hydra("--cfg", "-c", Shown | None, "Print the composed config and run nothing."),
    _hydra("--resolve", None, bool, "With --cfg: resolve ${…} before printing."),
    _hydra("--package", "-p", str | None, "With --cfg: only this key.", "KEY"),
    _hydra("--info", "-i", Info | None, "Print how the config is found and composed."),
    _hydra("--config-dir", "-cd", str | None, "Add a config folder of your own.", "DIR"),
    _hydra("--config-path", "-cp", str | None, "Use this config folder instead.", "DIR"),
    _hydra("--config-name", "-cn", str | None, "Use this primary config instead.", "NAME"),
    _hydra("--hydra-help", None, bool, "Print Hydra's own help."),
    _hydra("--shell-completion", "-sc", bool, "Hydra's own shell completion (install=bash)."),
)


@app.callback(invoke_without_command=True)
def _root(
    ctx: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        typer.echo(f"koopdqn {__version__}")
        raise typer.Exit
    if ctx.invoked_subcommand is None:
        typer.echo(ctx.get_help())


def _add_command(name: str, what: Command) -> None:
    flag, text = what.flag or ("", "")

    def command(*, overrides: list[str] | None, as_json: bool, debug: bool, **hydra: Any) -> int:
        given = [*(overrides or []), *([f"{name}.{flag}=true"] if flag and hydra.pop(flag) else [])]
        return guard(lambda: _compose_and_run(name, hydra, given, as_json=as_json), debug=debug)

    # Typer makes the options from this; no command has one that would do nothing.
    own = [_parameter(flag, bool, False, typer.Option(f"--{flag}", help=text))] if flag else []
    parameters = [*_OWN_OPTIONS, *own, *_HYDRA_OPTIONS]
    command.__signature__ = Signature(parameters, return_annotation=int)  # type: ignore[attr-defined]  # as in PEP 362
    shown = "\n\n".join(f"[bold]{example}[/]" for example in what.examples)
    app.command(name, short_help=what.summary, help=what.summary, epilog=f"Examples\n\n{shown}")(command)


for _name, _what in COMMANDS.items():
    _add_command(_name, _what)


@app.command("doctor")
def _doctor(as_json: AsJson = False, debug: Debug = False) -> int:
    """Say what of this machine works, and how to mend the rest."""
    from koopdqn.app import doctor

    return guard(lambda: doctor.run(as_json=as_json), debug=debug)


app.add_typer(feedback_app, name="feedback")


def _compose_and_run(name: str, hydra: Mapping[str, Any], overrides: Sequence[str], *, as_json: bool) -> int:
    from koopdqn.app.commands import run
    from koopdqn.app.hydra import application
    from koopdqn.app.hydra.overrides import prepare

    if hydra["cfg"] is None and (hydra["package"] is not None or hydra["resolve"]):
        raise BadInputError("--package and --resolve: need --cfg, found none")
    prepared = prepare(name, overrides, multirun=hydra["multirun"])
    # Hydra would take a relative path as relative to the module that calls it.
    path = hydra["config_path"] and str(Path(hydra["config_path"]).absolute())
    given = []
    for key, value in {**hydra, "config_path": path}.items():
        flag = f"--{key.replace('_', '-')}"
        if value:
            given.append(flag if value is True else f"{flag}={value}")
    if any(hydra[key] for key in ("cfg", "info", "hydra_help", "shell_completion")):
        if as_json:
            raise BadInputError("--json: prints a command's result and cannot be combined with --cfg or --info")
        # Hydra's help is about Hydra's own config, which has none of our keys
        return application.show(given, [] if hydra["hydra_help"] else prepared.overrides)
    return application.run(name, given, prepared.overrides, run, as_json=as_json, record=prepared.record)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    0 done; 1 the work itself failed; 2 bad input, told in one line; 130 interrupted (Ctrl-C, SIGTERM, SIGHUP).

    Args:
        arguments: what follows ``koopdqn`` on the command line; None reads ``sys.argv``.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if arguments is None:
        # The process ends with the command: collecting all that PyTorch holds would take a second.
        atexit.register(gc.freeze)
    before = gc.get_threshold()
    # What a command makes in its first seconds are modules, which stay; searching them takes a fifth of that time.
    gc.set_threshold(_YOUNG, *before[1:])
    missing = open_missing_streams()
    for stream in (sys.stdout, sys.stderr):
        # a terminal that cannot show ° or ρ must not end a run
        with contextlib.suppress(AttributeError, ValueError):
            stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]  # absent on replaced streams
    try:
        if "stdout" in missing and "--json" in given:
            console.fail("--json: standard output must be open, found it closed")
            return 2
        return guard(lambda: _run_app(given), debug="--debug" in given)
    finally:
        gc.set_threshold(*before)
        let_go_of_closed_streams()


def _run_app(arguments: Sequence[str]) -> int:
    try:
        status = app(_with_info_value(arguments), prog_name="koopdqn", standalone_mode=False)
    except Exception as error:
        # Typer's own usage errors share this method, whatever release of Typer raises them
        describe = getattr(error, "format_message", None)
        if describe is None:
            raise
        message = str(describe())
        if not message:
            # A group without a subcommand has shown its help.
            return 0
        console.fail(_usage(error, message))
        return 2
    return int(status or 0)


def _usage(error: Any, message: str) -> str:
    context = getattr(error, "ctx", None)
    if context is None:
        return message
    if hasattr(error, "option_name") and "o such option" in message:
        names = {name for parameter in context.command.params for name in parameter.opts if name.startswith("--")}
        valid = ", ".join(sorted(names | {"--help"}))
        return (
            f"unknown option {error.option_name} of {context.command_path}; valid: {valid}; settings are given without"
            " dashes, as seed=3"
        )
    if "No such command" in message:
        meant = [f"--{name}" for name in ("help", "version") if f"'{name}'" in message]
        return f"{message.rstrip('.')}; valid: {', '.join([*meant, *sorted(context.command.commands)])}"
    return message


def _with_info_value(arguments: Sequence[str]) -> list[str]:
    """Give a bare ``--info`` its value, as Hydra does; Typer's options always take one."""
    result: list[str] = []
    for argument, following in zip(arguments, [*arguments[1:], ""], strict=False):
        result.append(argument)
        if argument in ("--info", "-i") and (not following or following.startswith("-") or "=" in following):
            result.append("all")
    return result
