"""``koopdqn inspect``: what recordings hold, cleaned by named steps, and whether they are enough to learn from."""

from pathlib import Path

from rich.console import RenderableType
from rich.text import Text

from koopdqn import console
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.commands.demonstrations import read_and_cut, recognised
from koopdqn.app.hydra.application import CommandResult
from koopdqn.demonstrations.cleaning import STEPS, Cleaned, clean, without_outliers
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.derivation import Derivation
from koopdqn.demonstrations.hdf5 import write_hdf5
from koopdqn.demonstrations.inspection import compare, describe, findings
from koopdqn.demonstrations.preprocess import trim_idle_each
from koopdqn.demonstrations.schema import InspectedDemonstration, InspectedFile, InspectionFile
from koopdqn.errors import BadInputError
from koopdqn.files import write_json
from koopdqn.intent.fit import check_shown
from koopdqn.run_folder import DEMONSTRATIONS

_COLOURS = {"good": "green", "look": "yellow", "bad": "bold red"}


def inspect(config: Configuration, folder: Path) -> CommandResult:
    """Write ``inspect.json``, ``inspect.png`` and the cleaned ``demos.hdf5``, and tell what was found."""
    from koopdqn.plots.demos import plot_inspection

    read, demonstrations = read_and_cut(config, "inspect")
    # What does not move shows nothing, whichever steps are on.
    trim_idle_each([without_outliers(item) for item in demonstrations.items])
    cleaned = [_cleaned(config, demonstrations, index) for index in range(len(demonstrations))]
    items = [each.item for each in cleaned]
    beside = compare(items)
    deviation: list[float] | list[None] = beside.deviation_mm or [None] * len(items)
    each = [
        describe(raw, after, config.robot, far)
        for raw, after, far in zip(demonstrations.items, cleaned, deviation, strict=True)
    ]
    path, picture = folder / DEMONSTRATIONS, folder / "inspect.png"
    kept = Demonstrations(demonstrations.task, demonstrations.arm, items, 0, demonstrations.placement)
    write_hdf5(path, kept)
    plot_inspection(picture, demonstrations.items, items, each, beside.spread_mm, beside.left_out_mm, config.robot.name)
    report = InspectionFile(
        files=[InspectedFile(file=str(one.path), kind=one.kind, reasons=list(one.reasons)) for one in read],
        arm=config.robot.name,
        steps=[name for name in STEPS if getattr(config.inspect, name)],
        demonstrations=each,
        duplicates=beside.duplicates,
        odd=beside.odd,
        spread_mm=beside.spread_mm or None,
        spread_deg=beside.spread_deg or None,
        left_out_mm=beside.left_out_mm,
        enough=beside.enough,
        findings=findings(each, beside, config.robot.name, *_as_task(config, kept)),
        file=str(path),
        picture=str(picture),
    )
    result = report.model_dump(mode="json")
    write_json(folder / "inspect.json", result)
    lines: list[RenderableType] = [
        *recognised(read),
        _table(each),
        _findings(report),
        f"steps           {', '.join(report.steps) or 'none'}; signs are always continuous",
        f"cleaned         {console.shown_path(path)}",
        f"picture         {console.shown_path(picture)}",
    ]
    return CommandResult(result, lines)


def _cleaned(config: Configuration, demonstrations: Demonstrations, index: int) -> Cleaned:
    try:
        return clean(demonstrations.items[index], config.inspect)
    except BadInputError as error:
        raise BadInputError(f"demonstration {index}: {error}") from error


def _as_task(config: Configuration, demonstrations: Demonstrations) -> tuple[str, int]:
    """Return why demonstrations make no task, or do not belong to the one that was chosen; an empty text if they do.

    Returned too is how many legs the path of the task made of them has.
    """
    try:
        if isinstance(config.chosen, Derivation):
            recipe = config.chosen.model_copy(update={"holdout": 0})
            derived = recipe.derive(demonstrations, continuous=config.agent.continuous, unfolds=config.intent.unfolds)
            return "", len(derived.task.legs(derived.task.nominal_start))
        check_shown(demonstrations, config.task)
    except BadInputError as error:
        return str(error), 1
    return "", 1


def _table(each: list[InspectedDemonstration]) -> RenderableType:
    rows = [
        (
            str(index),
            f"{one.kept}/{one.samples}",
            f"{one.seconds:.1f}",
            f"{1e3 * one.length_m:.0f}",
            f"{one.turn_deg:.0f}",
            f"{one.noise_mm:.2f}",
            f"{100 * one.reached:.0f}",
            "–" if one.joint_speed is None else f"{100 * one.joint_speed:.0f}",
            "–" if one.singular is None else f"{one.singular:.3f}",
            "–" if one.deviation_mm is None else f"{one.deviation_mm:.1f}",
        )
        for index, one in enumerate(each)
    ]
    # What a terminal of 80 columns has room for; the rest is in inspect.json.
    headings = (
        "",
        "samples",
        "time\n[s]",
        "path\n[mm]",
        "turn\n[°]",
        "noise\n[mm]",
        "reach\n[%]",
        "speed\n[%]",
        "singular",
        "off\n[mm]",
    )
    caption = "speed: a joint's, of its limit; singular: least singular value; off: from the others' mean"
    return console.table(headings, rows, (), whole="words", caption=caption)


def _findings(report: InspectionFile) -> RenderableType:
    rows = [(one.name, Text(one.state, style=_COLOURS[one.state]), one.text) for one in report.findings]
    return console.table(("looked at", "", "found"), rows, ("looked at", "", "found"))
