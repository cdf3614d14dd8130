"""``koopdqn fit``: fit the human intent model and its trust domain."""

from pathlib import Path

from rich.console import RenderableType
from rich.table import Table

from koopdqn import console
from koopdqn.commands import stages
from koopdqn.commands.configuration import Configuration
from koopdqn.result import CommandResult


def run(config: Configuration, folder: Path) -> CommandResult:
    """Fit to given or new demonstrations; write ``intent.npz``, ``fit.json`` and ``fit.png``."""
    workcell = stages.open_scene(config)
    demonstrations = stages.demonstrations_for(config, workcell, folder)
    _, fitted = stages.fitted_intent(config, demonstrations, folder)
    report = fitted.report
    one_step, sixty = report["one_step_error_m"], report["sixty_samples"]
    roll_out, trust = report["roll_out_error_m"], report["trust"]
    table = Table(title=f"Intent {config.intent.name} on task {config.task.name}, one demonstration left out at a time")
    table.add_column("measure")
    table.add_column("value", justify="right")
    rows = (
        ("one-step error, RMS", f"{one_step['rms'] * 1e3:.3f} mm"),
        ("one-step error, largest", f"{one_step['max'] * 1e3:.3f} mm"),
        (
            "at 60 samples: RMS over persistence (predicting no motion)",
            f"{sixty['rms_over_persistence']:.3f}",
        ),
        (
            "at 60 samples: largest error (the paper: 2.3 mm)",
            f"{sixty['max_m'] * 1e3:.2f} mm",
        ),
        ("rolled out: goal reached", f"{roll_out['reached_goal']} of {report['demonstrations']}"),
        ("rolled out: median Hausdorff distance", f"{roll_out['median_hausdorff'] * 1e3:.1f} mm"),
        ("spectral radius of K", f"{report['spectral_radius']:.5f}"),
        ("held-out states in the trust domain", f"{trust['held_out_state_coverage']:.1%}"),
        ("demonstrated steps that no action matches", f"{report['unmatched_share']:.1%}"),
    )
    for name, value in rows:
        table.add_row(name, value)
    lines: list[RenderableType] = [
        table,
        f"intent   {console.shown_path(folder / stages.INTENT)}",
        f"report   {console.shown_path(folder / 'fit.json')}",
        f"picture  {console.shown_path(folder / 'fit.png')}",
    ]
    return CommandResult(report, lines, objective=roll_out["median_hausdorff"])
