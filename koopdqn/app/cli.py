"""The command line: parse, compose the config, call one function, print."""

import contextlib
import sys
from collections.abc import Mapping, Sequence
from enum import StrEnum
from inspect import signature
from pathlib import Path
from typing import Annotated, Any

import typer

from koopdqn import __version__, console
from koopdqn.app.exit_status import guard, let_go_of_closed_streams, open_missing_streams
from koopdqn.app.feedback_cli import feedback_app
from koopdqn.errors import BadInputError

_COMMANDS = {
    "demo": (
        "Generate demonstrations of a task, or record them with the keyboard.",
        (
            "koopdqn demo task=shelf",
            "koopdqn demo task=knife seed=3 out=runs/demos",
            "koopdqn demo source=keyboard",
            "koopdqn demo run=DIR  (goes on with a recording)",
        ),
    ),
    "fit": (
        "Fit the human intent model and its trust domain.",
        ("koopdqn fit demos=runs/demos/demos.hdf5", "koopdqn fit intent=paper"),
    ),
    "train": (
        "Learn the path; demonstrations and intent model are made first where they are missing.",
        (
            "koopdqn train task=shelf",
            "koopdqn train -m task=shelf,knife seed=0,1",
            "koopdqn train run=DIR  (goes on where a run stopped)",
        ),
    ),
    "eval": (
        "Measure a trained run on held-out starts.",
        ("koopdqn eval", "koopdqn eval run=DIR --json"),
    ),
    "report": (
        "Draw the paper's figures and tables beside ours, from finished runs.",
        ("koopdqn report", "koopdqn report --make", "koopdqn report 'report.runs=[DIR,DIR]'"),
    ),
    "import": (
        "Read real demonstrations (CSV or HDF5), check them and keep them as one HDF5 file.",
        ("koopdqn import demos=log.csv", "koopdqn import 'demos=logs/*.csv' out=runs/mine"),
    ),
    "export": (
        "Write demonstrations as CSV.",
        ("koopdqn export demos=runs/mine/demos.hdf5", "koopdqn export demos=demos.hdf5 export.rotation=vector"),
    ),
}
"""The commands that take a config: what each does, and examples."""

app = typer.Typer(
    name="koopdqn",
    help="Teach a robot arm the path a person would choose.",
    epilog="Begin with [bold]koopdqn train task=shelf[/]; it needs nothing else.",
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


class Shown(StrEnum):
    """What ``--cfg`` prints."""

    JOB = "job"
    HYDRA = "hydra"
    ALL = "all"


class Info(StrEnum):
    """What ``--info`` prints."""

    ALL = "all"
    CONFIG = "config"
    DEFAULTS = "defaults"
    DEFAULTS_TREE = "defaults-tree"
    PLUGINS = "plugins"
    SEARCHPATH = "searchpath"


def _complete(ctx: typer.Context, incomplete: str) -> list[str]:
    from koopdqn.app.hydra.completion import complete

    return complete(ctx.params.get("overrides") or [], incomplete, ctx.params.get("config_dir"))


_HYDRA = "Hydra"

Overrides = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="OVERRIDE",
        help="Config overrides: [cyan]group=option[/] or [cyan]key=value[/]; groups are task, intent, trust, oracle, "
        "agent, robot, preset. [cyan]out=DIR[/] names the run folder, [cyan]seed=N[/] fixes everything.",
        autocompletion=_complete,
        show_default=False,
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON to standard output and nothing else.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]
MultiRun = Annotated[
    bool, typer.Option("--multirun", "-m", help="Sweep over comma-separated values.", rich_help_panel=_HYDRA)
]
Cfg = Annotated[
    Shown | None,
    typer.Option("--cfg", "-c", help="Print the composed config and run nothing.", rich_help_panel=_HYDRA),
]
Resolve = Annotated[
    bool, typer.Option("--resolve", help="With --cfg: resolve ${…} before printing.", rich_help_panel=_HYDRA)
]
Package = Annotated[
    str | None,
    typer.Option("--package", "-p", metavar="KEY", help="With --cfg: only this key.", rich_help_panel=_HYDRA),
]
InfoOption = Annotated[
    Info | None,
    typer.Option("--info", "-i", help="Print how the config is found and composed.", rich_help_panel=_HYDRA),
]
ConfigDir = Annotated[
    str | None,
    typer.Option("--config-dir", "-cd", metavar="DIR", help="Add a config folder of your own.", rich_help_panel=_HYDRA),
]
ConfigPath = Annotated[
    str | None,
    typer.Option("--config-path", "-cp", metavar="DIR", help="Use this config folder instead.", rich_help_panel=_HYDRA),
]
ConfigName = Annotated[
    str | None,
    typer.Option(
        "--config-name", "-cn", metavar="NAME", help="Use this primary config instead.", rich_help_panel=_HYDRA
    ),
]
Make = Annotated[
    bool, typer.Option("--make", help="Train and evaluate what is missing first; the same as report.make=true.")
]
HydraHelp = Annotated[bool, typer.Option("--hydra-help", help="Print Hydra's own help.", rich_help_panel=_HYDRA)]
RunFlag = Annotated[bool, typer.Option("--run", "-r", help="Run one job (the default).", rich_help_panel=_HYDRA)]
ShellCompletion = Annotated[
    bool,
    typer.Option(
        "--shell-completion", "-sc", help="Hydra's own shell completion (install=bash).", rich_help_panel=_HYDRA
    ),
]


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


def _add_command(name: str, summary: str, examples: Sequence[str]) -> None:
    def command(
        overrides: Overrides = None,
        as_json: AsJson = False,
        debug: Debug = False,
        make: Make = False,
        multirun: MultiRun = False,
        run: RunFlag = False,
        cfg: Cfg = None,
        resolve: Resolve = False,
        package: Package = None,
        info: InfoOption = None,
        config_dir: ConfigDir = None,
        config_path: ConfigPath = None,
        config_name: ConfigName = None,
        hydra_help: HydraHelp = False,
        shell_completion: ShellCompletion = False,
    ) -> int:
        def work() -> int:
            if cfg is None and (package is not None or resolve):
                raise BadInputError("--package and --resolve: need --cfg, found none")
            options = {
                "--multirun": multirun,
                "--run": run,
                "--resolve": resolve,
                "--hydra-help": hydra_help,
                "--shell-completion": shell_completion,
                "--cfg": cfg,
                "--package": package,
                "--info": info,
                "--config-dir": config_dir,
                # Hydra would take a relative path as relative to the module that calls it
                "--config-path": config_path and str(Path(config_path).absolute()),
                "--config-name": config_name,
            }
            given = [*(overrides or []), *(["report.make=true"] if make else [])]
            return _compose_and_run(name, options, given, as_json=as_json)

        return guard(work, debug=debug)

    if name != "report":
        kept = [item for item in signature(command).parameters.values() if item.name != "make"]
        # Typer makes the options from this, so that no other command has one that would do nothing.
        command.__signature__ = signature(command).replace(parameters=kept)  # type: ignore[attr-defined]  # as in PEP 362
    shown = "\n\n".join(f"[bold]{example}[/]" for example in examples)
    app.command(name, short_help=summary, help=summary, epilog=f"Examples\n\n{shown}")(command)


for _name, (_summary, _examples) in _COMMANDS.items():
    _add_command(_name, _summary, _examples)


@app.command("doctor")
def _doctor(as_json: AsJson = False, debug: Debug = False) -> int:
    """Say what of this machine works, and how to mend the rest."""

    def work() -> int:
        from koopdqn.app import doctor

        return doctor.run(as_json=as_json)

    return guard(work, debug=debug)


app.add_typer(feedback_app, name="feedback")


def _compose_and_run(name: str, options: Mapping[str, object], overrides: Sequence[str], *, as_json: bool) -> int:
    from koopdqn.app.commands import run
    from koopdqn.app.hydra import application
    from koopdqn.app.hydra.overrides import prepare

    prepared = prepare(name, overrides, multirun=bool(options["--multirun"]))
    given = [option if value is True else f"{option}={value}" for option, value in options.items() if value]
    if any(options[option] for option in ("--cfg", "--info", "--hydra-help", "--shell-completion")):
        if as_json:
            raise BadInputError("--json: prints a command's result and cannot be combined with --cfg or --info")
        # Hydra's help is about Hydra's own config, which has none of our keys
        return application.show(name, given, [] if options["--hydra-help"] else prepared.overrides)
    return application.run(name, given, prepared.overrides, run, as_json=as_json, continues=prepared.continues)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    0 done; 1 the work itself failed; 2 bad input, told in one line; 130 interrupted (Ctrl-C, SIGTERM, SIGHUP).

    Args:
        arguments: what follows ``koopdqn`` on the command line; None reads ``sys.argv``.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
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
        let_go_of_closed_streams()


def _run_app(arguments: Sequence[str]) -> int:
    try:
        status = app(_with_info_value(arguments), prog_name="koopdqn", standalone_mode=False)
    except Exception as error:
        # Typer's own usage errors share this method, whatever release of Typer raises them
        describe = getattr(error, "format_message", None)
        if describe is None:
            raise
        console.fail(_usage(error, str(describe())))
        return 2
    return int(status or 0)


def _usage(error: Any, message: str) -> str:
    context = getattr(error, "ctx", None)
    if context is None:
        return message
    if hasattr(error, "option_name") and "o such option" in message:
        names = {name for parameter in context.command.params for name in parameter.opts if name.startswith("--")}
        valid = ", ".join(sorted(names | {"--help"}))
        return f"unknown option {error.option_name} of {context.command_path}; valid: {valid}"
    if "No such command" in message:
        return f"{message.rstrip('.')}; valid: {', '.join(sorted(context.command.commands))}"
    return message


def _with_info_value(arguments: Sequence[str]) -> list[str]:
    """Give a bare ``--info`` its value, as Hydra does; Typer's options always take one."""
    result: list[str] = []
    for argument, following in zip(arguments, [*arguments[1:], ""], strict=False):
        result.append(argument)
        if argument in ("--info", "-i") and (not following or following.startswith("-") or "=" in following):
            result.append(Info.ALL.value)
    return result
