"""The table of the commands that take a config: all that tells one from another, in one place.

The command line's help, the preparation of overrides and the running of a command read it; the module imports nothing
that takes time.
"""

from dataclasses import dataclass
from typing import Final, Literal


@dataclass(frozen=True)
class Command:
    """A command that takes a config.

    Attributes:
        summary: what it does.
        examples: of calling it.
        function: that does it, and its module, below ``koopdqn.app.commands``.
        looks_at: the trained run that it looks at: one that ``run=DIR`` may have "named", or that is "needed" so, or
            the "newest" below ``runs/`` where none is named; "" for none.
        goes_on_with: what ``run=DIR`` is to name where the command goes on in that folder; "" where it does not.
        demos: what ``demos=`` is taken for: to "learn" from, kept in the command's own folder with the task that they
            may make; "any", of whichever task they make unless ``task=`` is given; "files", the same, and these may
            stand without ``demos=``; "" where it is not taken.
        intent_file: whether ``intent=FILE`` is taken.
        most_runs: how many ``run=DIR`` are taken; above 1, two are the least.
        own_keys: of its section, that need no prefix.
        flag: an option of its own, a key of its section that is set to true, and its help.
        once: why it cannot be swept; "" where it can.
    """

    summary: str
    examples: tuple[str, ...]
    function: str
    looks_at: Literal["", "named", "needed", "newest"] = ""
    goes_on_with: str = ""
    demos: Literal["", "learn", "any", "files"] = ""
    intent_file: bool = False
    most_runs: int = 1
    own_keys: tuple[str, ...] = ()
    flag: tuple[str, str] | None = None
    once: str = ""

    @property
    def inputs(self) -> dict[str, bool]:
        """Each of the root's keys that name what commands begin with: whether this one takes it."""
        run = bool(self.looks_at or self.goes_on_with)
        return {"run": run, "demos": bool(self.demos), "intent_file": self.intent_file}


COMMANDS: Final = {
    "demo": Command(
        "Generate demonstrations of a task, or record them with the keyboard.",
        (
            "koopdqn demo task=shelf",
            "koopdqn demo task=knife seed=3 out=runs/demos",
            "koopdqn demo source=keyboard",
            "koopdqn demo run=DIR  (goes on with a recording)",
        ),
        "demonstrations.demo",
        goes_on_with="a recording",
    ),
    "fit": Command(
        "Fit the human intent model and its trust domain.",
        ("koopdqn fit demos=runs/demos/demos.hdf5", "koopdqn fit intent=paper"),
        "fit.run",
        demos="learn",
    ),
    "train": Command(
        "Learn the path; demonstrations and intent model are made first where they are missing.",
        (
            "koopdqn train task=shelf",
            "koopdqn train -m task=shelf,knife seed=0,1",
            "koopdqn train run=DIR  (goes on where a run stopped)",
        ),
        "train.run",
        goes_on_with="a training run",
        demos="learn",
        intent_file=True,
    ),
    "eval": Command(
        "Measure a trained run on held-out starts.",
        ("koopdqn eval", "koopdqn eval run=DIR --json"),
        "eval.run",
        looks_at="newest",
        own_keys=("goal", "video"),
    ),
    "correct": Command(
        "Correct a stretch of a learned path by keys or waypoints; the rest stays as it is.",
        (
            "koopdqn correct run=DIR  (plays the path; stop it and show the better way)",
            "koopdqn correct run=DIR 'waypoints=[[0.44,-0.06,0.56],[0.45,0.0,0.58]]'",
            "koopdqn correct run=DIR waypoints=better.csv",
        ),
        "correct.run",
        looks_at="needed",
    ),
    "view": Command(
        "Look at a trained run, or at demonstrations, as a page that opens in any browser.",
        (
            "koopdqn view",
            "koopdqn view run=DIR",
            "koopdqn view demos=demos.hdf5",
            "koopdqn view run=DIR video=film.mp4",
            "koopdqn view run=DIR window=true  (MuJoCo's viewer, where there is a display)",
        ),
        "view.run",
        looks_at="newest",
        demos="any",
        own_keys=("video", "window"),
    ),
    "explain": Command(
        "Say why a policy does what it does in one state, or where a path went wrong.",
        (
            "koopdqn explain",
            "koopdqn explain run=DIR start=3",
            "koopdqn explain run=DIR start=3 step=57 --json",
            "koopdqn explain run=DIR 'pose=[0.45,-0.2,0.45,0.707,0,0.707,0]'",
        ),
        "explain.run",
        looks_at="newest",
        own_keys=("start", "step", "pose"),
    ),
    "compare": Command(
        "Set trained runs of a task side by side: one table, and one page of their paths.",
        ("koopdqn compare run=DIR run=DIR", "koopdqn compare run=DIR run=DIR run=DIR view.starts=3 --json"),
        "compare.run",
        looks_at="needed",
        most_runs=6,
    ),
    "report": Command(
        "Draw the paper's figures and tables beside ours, from finished runs; or gather a sweep.",
        (
            "koopdqn report",
            "koopdqn report --make",
            "koopdqn report 'report.runs=[DIR,DIR]'",
            "koopdqn report sweep=DIR  (of koopdqn train -m: its runs in one table and plot)",
        ),
        "report.run",
        flag=("make", "Train and evaluate what is missing first; the same as report.make=true."),
    ),
    "import": Command(
        "Recognise and read recordings of any kind, check them and keep them as one HDF5 file.",
        (
            "koopdqn import log.csv",
            "koopdqn import logs/*.csv import.units=mm out=runs/mine",
            "koopdqn import bag.mcap import.pose=tool0",
        ),
        "demonstrations.import_",
        demos="files",
    ),
    "inspect": Command(
        "Clean demonstrations by named steps and say what they are good for; the source stays as it is.",
        ("koopdqn inspect logs/*.csv", "koopdqn inspect log.csv inspect.smoothing=false robot=ur5"),
        "inspection.inspect",
        demos="files",
    ),
    "export": Command(
        "Write a learned path as a robot program, or demonstrations as CSV.",
        (
            "koopdqn export run=DIR",
            "koopdqn export run=DIR 'start=[0.52,-0.2,0.41,0.707,0,0.707,0]'",
            "koopdqn export demos=runs/mine/demos.hdf5",
            "koopdqn export demos=demos.hdf5 export.rotation=vector",
        ),
        "demonstrations.export",
        looks_at="named",
        demos="any",
    ),
    "stream": Command(
        "Send a learned path to a UR's controller while the arm moves; without --move nothing is sent.",
        (
            "koopdqn stream run=DIR",
            "koopdqn stream run=DIR host=192.168.1.10  (reads where the arm stands)",
            "koopdqn stream run=DIR host=192.168.1.10 --move  (any key stops the arm)",
        ),
        "program.stream_path",
        looks_at="named",
        flag=("move", "Move the arm; the same as stream.move=true. Any key stops it."),
        once="moves one arm once",
    ),
}
"""In the order of the help."""
