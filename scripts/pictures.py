"""Draws the pictures of the documentation anew: `make pictures`, or ``python scripts/pictures.py NAME …`` for some.

Most come from two trainings of the shelf task with seed 0, one of them stopped too early on purpose; a small sweep and
demonstrations of the knife task are made too, and a training with continuous actions. Pictures of pages need Chromium;
without it they stay as they are.
"""

import argparse
import contextlib
import io
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import PIL.Image
from benchmarks.learning import prepare
from matplotlib.font_manager import findfont
from PIL import ImageDraw, ImageFont
from rich.color_triplet import ColorTriplet
from rich.style import Style
from rich.text import Text

import koopdqn
from koopdqn import console
from koopdqn.app import cli
from koopdqn.console import LiteralConsole
from koopdqn.errors import WorkFailedError
from koopdqn.files import write_text
from koopdqn.oracles.base import Answer, Oracle, Question
from koopdqn.oracles.terminal.picture import SituationCamera, block_lines
from koopdqn.oracles.terminal.screen import Shown, compose
from koopdqn.oracles.terminal.window import PICTURE_SIZE, region
from koopdqn.plots.style import DEMONSTRATED, picture, rgba, show_image
from koopdqn.plots.workflow import plot_workflow
from koopdqn.pose import POSITION
from koopdqn.rl.checks import Check
from koopdqn.robot.render import Camera, Ghost, Line
from koopdqn.robot.view import View, choose_view
from koopdqn.view.dashboard import Dashboard

ROOT: Final = Path(__file__).resolve().parents[1]
IMAGES: Final = ROOT / "docs" / "images"
SIZES: Final = ((80, 24), (140, 40))
"""Of the dashboard's terminals, columns and rows."""
ARMS: Final = ("ur3", "ur5", "ur10", "ur3e", "ur5e", "ur10e", "ur16e")
ARM_SIZE: Final = (720, 640)
"""Width and height of an arm's picture [pixels]."""
_QUESTION: Final = 5
_SCREEN: Final = (120, 40)
_CELL: Final = (9, 18)
"""Columns and rows of the terminal that asks, and the pixels of a character."""
_INK: Final = ColorTriplet(204, 204, 204)
_GROUND: Final = ColorTriplet(16, 16, 16)
MOST_BYTES: Final = 2_000_000
_FETCHED: Final = re.compile(r"@font-face \{.*?\}", re.DOTALL)
_CHROMIUM: Final = ("chromium", "chromium-browser", "google-chrome")
_FLAGS: Final = ("--headless=new", "--no-sandbox", "--hide-scrollbars", "--use-gl=angle", "--use-angle=swiftshader")
_SHORT: Final = ("train.check_every=20", "train.max_steps=9000")
_SWEPT: Final = ("demo.count=3", "train.max_steps=30000", "train.check_every=50", "seed=0,1", "agent.gamma=0.3,0.7")


class Runs:
    """The runs that pictures are of, each made when it is first asked for."""

    def __init__(self, folder: Path) -> None:
        """Make them below a folder."""
        self.folder = folder

    def learned(self) -> Path:
        """Return the folder of a finished training of the shelf task."""
        return self._made("learned", "train", "task=shelf", "seed=0")

    def stopped(self) -> Path:
        """Return the folder of one from the same demonstrations that was stopped too early."""
        inputs = (f"demos={self.learned() / 'demos.hdf5'}", f"intent={self.learned() / 'intent.npz'}")
        return self._made("stopped", "train", "task=shelf", "seed=0", *inputs, *_SHORT)

    def shown(self) -> Path:
        """Return the folder of demonstrations of the knife task, which turn."""
        return self._made("shown", "demo", "task=knife", "seed=0")

    def swept(self) -> Path:
        """Return the folder of a small sweep."""
        return self._made("swept", "train", "-m", "task=shelf", *_SWEPT)

    def measured(self, run: Path) -> Path:
        """Return the folder of a run's evaluation, where the report of its sweep finds it."""
        out = str(run.relative_to(self.folder) / "eval")
        return self._made(out, "eval", f"run={run}", "eval.dynamics=false", "eval.baselines=false")

    def of(self, command: str, *overrides: str) -> Path:
        """Return the folder of a command that looks at runs."""
        return self._made(f"{command}{len(list(self.folder.iterdir()))}", command, *overrides)

    def _made(self, name: str, command: str, *overrides: str) -> Path:
        out = self.folder / name
        # A training that did not learn is a result as well.
        well = 1 if command == "train" else 0
        if not out.exists() and cli.main([command, *overrides, f"out={out}"]) > well:
            raise WorkFailedError(f"koopdqn {command} {' '.join(overrides)} failed")
        return out


def dashboard(runs: Runs) -> None:
    """Draw the dashboard at two sizes, as it stands after the third check of a training."""
    prepared = prepare("task=shelf", "seed=0")
    trainer = prepared.trainer()
    pages = [LiteralConsole(record=True, width=w, height=h, file=io.StringIO(), force_terminal=True) for w, h in SIZES]
    boards = [Dashboard(trainer, prepared.shown, None, page) for page in pages]

    def on_check(check: Check) -> None:
        if len(trainer.history.checks) == 3:
            for page, board in zip(pages, boards, strict=True):
                page.print(board.content())
                # What is shown fetches nothing.
                text = _FETCHED.sub("", page.export_svg(title="koopdqn train task=shelf"))
                write_text(IMAGES / f"dashboard-{page.width}x{page.height}.svg", text)

    trainer.run(on_check)


def question(runs: Runs) -> None:
    """Draw a question of a training as it stands on a terminal."""
    config = koopdqn.load_config("task=shelf", "seed=0")
    demonstrations = koopdqn.generate(config)
    cell, asked = koopdqn.open_workcell(config), _Asked()
    asked.scripted = config.oracle.open(cell, config.inputs.seed, runs.folder)
    koopdqn.train(config, demonstrations, koopdqn.fit(config, demonstrations), asked)
    shown, (width, height) = asked.questions[_QUESTION], _SCREEN
    place = region(width, height, pictures=True)
    with contextlib.closing(SituationCamera(cell, PICTURE_SIZE["blocks"])) as camera:
        found = camera.picture(shown)
    lines = block_lines(found.image, place.width, place.rows, found.marks, colour=True)
    content = Shown(cell.task, "anna", shown, "Answered: right", lines, found.times)
    _terminal(compose(content, width, height, pictures=True), width).save(IMAGES / "feedback.png", optimize=True)


class _Asked(Oracle):
    """The scripted oracle, whose questions are kept."""

    scripted: Oracle

    def __init__(self) -> None:
        self.questions: list[Question] = []

    def answer(self, question: Question) -> Answer:
        """Return the script's answer."""
        self.questions.append(question)
        return self.scripted.answer(question)


def _terminal(lines: list[Text], width: int) -> PIL.Image.Image:
    """Return lines of text as a terminal of black ground shows them."""
    font = ImageFont.truetype(findfont("DejaVu Sans Mono"), 15)
    image = PIL.Image.new("RGB", (width * _CELL[0], len(lines) * _CELL[1]), _GROUND)
    pen = ImageDraw.Draw(image)
    terminal = LiteralConsole(file=io.StringIO(), force_terminal=True, color_system="truecolor", width=width)
    for row, line in enumerate(lines):
        column = 0
        for segment in terminal.render(line, terminal.options.update(width=width, no_wrap=True)):
            style = segment.style or Style()
            ink = _INK if style.color is None else style.color.get_truecolor()
            ground = _GROUND if style.bgcolor is None else style.bgcolor.get_truecolor()
            if style.reverse:
                ink, ground = ground, ink
            for character in segment.text.rstrip("\n"):
                x, y = column * _CELL[0], row * _CELL[1]
                pen.rectangle((x, y, x + _CELL[0] - 1, y + _CELL[1] - 1), ground)
                if character == "▀":
                    pen.rectangle((x, y, x + _CELL[0] - 1, y + _CELL[1] // 2 - 1), ink)
                else:
                    pen.text((x, y), character, ink, font, stroke_width=0.3 if style.bold else 0)
                column += 1
    return image


def film(runs: Runs) -> None:
    """Make the film that the README opens with, and a frame of it."""
    path = runs.folder / "film.gif"
    runs.of("view", f"run={runs.learned()}", "view.starts=1", f"video={path}")
    if path.stat().st_size > MOST_BYTES:
        raise WorkFailedError(f"the film must take at most {MOST_BYTES} bytes, found {path.stat().st_size}")
    shutil.copyfile(path, IMAGES / "film.gif")
    with PIL.Image.open(path) as frames:
        frames.seek(60)
        frames.convert("RGB").save(IMAGES / "film.png", optimize=True)


def explain(runs: Runs) -> None:
    """Draw where a path of the run that was stopped too early went wrong."""
    _copy(runs.of("explain", f"run={runs.stopped()}") / "explain.png")


def demos(runs: Runs) -> None:
    """Draw demonstrations as `koopdqn inspect` sees them."""
    given = f"demos={runs.shown() / 'demos.hdf5'}"
    _copy(runs.of("inspect", given) / "inspect.png")


def program(runs: Runs) -> None:
    """Draw the robot program of the learned path."""
    _copy(runs.of("export", f"run={runs.learned()}") / "program.png")


def obstacles(runs: Runs) -> None:
    """Draw the paths of a policy that never saw the obstacles, led around them."""
    given = f"obstacles={ROOT / 'examples' / 'obstacles.yaml'}"
    picture = runs.of("eval", f"run={runs.learned()}", given, "eval.dynamics=false") / "eval.png"
    _copy(picture, "obstacles.png")


def correction(runs: Runs) -> None:
    """Draw the paths of a policy one stretch of which a person led 40 mm higher, as docs/corrections.md has it."""
    higher = "[[0.436,-0.060,0.563],[0.436,-0.028,0.588],[0.450,0.001,0.581],[0.472,0.023,0.555]]"
    corrected = runs.of("correct", f"run={runs.learned()}", f"waypoints={higher}")
    _copy(
        runs.of("eval", f"run={corrected}", "eval.dynamics=false", "eval.baselines=false") / "eval.png",
        "correction.png",
    )


def continuous(runs: Runs) -> None:
    """Draw the paths that were learned with any direction."""
    trained = runs.of("train", "task=shelf", "seed=0", "actions=continuous")
    _copy(runs.of("eval", f"run={trained}", "eval.dynamics=false") / "eval.png", "continuous.png")


def arms(runs: Runs) -> None:
    """Draw the arms of the UR family in the shelf task's scene, all seen from the same place."""
    drawn: dict[str, Any] = {}
    view: View | None = None
    for name in reversed(ARMS):
        config = koopdqn.load_config("task=shelf", f"robot={name}", "demo.count=1")
        scene, [shown] = koopdqn.open_workcell(config).scene, koopdqn.generate(config).items
        assert shown.joints is not None, "a demonstration that was generated"
        view = view or choose_view(scene, shown.joints, ARM_SIZE)
        with closing(Camera(scene, ARM_SIZE)) as camera:
            line = Line(shown.poses[:, POSITION], rgba(DEMONSTRATED))
            drawn[name] = camera.picture(shown.joints[-1], view, [line], ghosts=[Ghost(shown.joints[0])])
    with picture(runs.folder / "arms.png", "The shelf task on the arms of the UR family", 1560, 760) as figure:
        for axes, name in zip(figure.subplots(2, 4).flat, (*ARMS[:3], "", *ARMS[3:]), strict=True):
            if name:
                show_image(axes, drawn[name], name)
            else:
                axes.set_axis_off()
    _copy(runs.folder / "arms.png")


def workflow(runs: Runs) -> None:
    """Draw the algorithm as boxes and arrows."""
    path = runs.folder / "workflow.png"
    plot_workflow(path)
    _copy(path)


def sweep(runs: Runs) -> None:
    """Draw a sweep's spread over seeds."""
    for trained in sorted(runs.swept().glob("*/policy.safetensors")):
        runs.measured(trained.parent)
    _copy(runs.of("report", f"sweep={runs.swept()}") / "report" / "sweep.png")


def pages(runs: Runs) -> None:
    """Take pictures of the pages of `koopdqn view` and `koopdqn compare`."""
    _screenshot(runs.of("view", f"run={runs.learned()}") / "view.html", "view.png")
    runs.measured(runs.learned())
    both = (f"run={runs.learned()}", f"run={runs.stopped()}")
    _screenshot(runs.of("compare", *both, "view.starts=3") / "compare.html", "compare.png")


def _copy(picture: Path, name: str = "") -> None:
    with PIL.Image.open(picture) as shown:
        shown.convert("RGB").save(IMAGES / (name or picture.name), optimize=True)


def _screenshot(page: Path, name: str) -> None:
    browser = next(filter(None, map(shutil.which, _CHROMIUM)), None)
    if browser is None:
        console.warn(f"{name} stays as it is: there is no Chromium here")
        return
    # The middle of the first motion tells more than its start.
    page.write_text(page.read_text(encoding="utf-8") + "<script>view.seek(60)</script>", encoding="utf-8")
    picture = page.with_name(name).absolute()
    options = [f"--screenshot={picture}", "--window-size=1280,800", "--virtual-time-budget=20000"]
    command = [browser, *_FLAGS, "--enable-unsafe-swiftshader", *options, page.resolve().as_uri()]
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    _copy(picture)


PICTURES: Final[dict[str, Callable[[Runs], None]]] = {
    each.__name__: each
    for each in (
        dashboard,
        question,
        film,
        explain,
        demos,
        program,
        obstacles,
        correction,
        continuous,
        arms,
        workflow,
        sweep,
        pages,
    )
}


def main() -> int:
    """Draw the pictures that were asked for, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help=f"of {', '.join(PICTURES)}; none: all")
    names = parser.parse_args().names or list(PICTURES)
    for name in names:
        if name not in PICTURES:
            parser.error(f"unknown picture {name!r}; valid: {', '.join(PICTURES)}")
    # Within it, so that pages name its runs alone.
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        runs = Runs(Path(folder))
        for name in names:
            console.note(f"pictures: {name}")
            PICTURES[name](runs)
    return 0


if __name__ == "__main__":
    sys.exit(main())
