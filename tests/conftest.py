"""What every test shares: off-screen rendering, the marker of slow tests, reproducible examples, the shelf."""

import gc
import os
import pickle
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import import_module
from typing import TYPE_CHECKING, Any

import pytest
from absl import logging as absl_logging
from hypothesis import settings

if TYPE_CHECKING:
    from parts import Parts

    from koopdqn.demonstrations.dataset import Demonstrations
    from koopdqn.intent.fit import Fitted
    from koopdqn.intent.reward import IntentReward
    from koopdqn.pose import Array
    from koopdqn.robot.scene import Scene
    from koopdqn.robot.ur import URArm
    from koopdqn.tasks.shelf import ShelfTask
    from koopdqn.tasks.workcell import Workcell

# MuJoCo reads how to draw once, at its first import; this chooses it, whichever test comes first.
import_module("koopdqn.robot")

# Whoever runs the tests may ignore hangups, as nohup does; what the tests start would inherit that.
signal.signal(signal.SIGHUP, signal.SIG_DFL)

# PyTorch's CUDA builds bring Triton, which crashes where Mesa's renderer has loaded another LLVM before it.
with suppress(ImportError):
    import_module("triton")

# Modules that stay would be searched for circles again and again, which takes a tenth of the tests' time.
gc.set_threshold(50_000)

# Hydra closes every log handler when it sets up its own; absl's (of dm_control) would close pytest's captured stream.
absl_logging.get_absl_handler().python_handler.setStream(sys.__stderr__)

# A process for every file costs more than all else in these, the more so where coverage is counted.
_READ_HERE = (
    "test_csv",
    "test_people_sets",
    "test_reading",
    "test_recording_arrays",
    "test_recording_cutting",
    "test_recording_joints",
    "test_recording_ros",
    "test_recording_text",
)

# Pictures are by the way in these, and take half of a small training's time; test_plots.py and others look at them.
_UNDRAWN = (
    "test_bad_input",
    "test_cli",
    "test_compare",
    "test_derivation_placement",
    "test_explain",
    "test_inspection",
    "test_interruption",
    "test_mjcf_arm",
    "test_own_data",
    "test_pipeline",
    "test_questions",
    "test_report",
    "test_schemas",
    "test_streaming",
    "test_threads",
    "test_untrusted_run",
    "test_view_command",
)

NO_OPENGL = "OpenGL's libraries are missing here, see `koopdqn doctor`"

# They take longest; begun last, they would leave the other workers idle.
_LONGEST = (
    "test_pipeline",
    "test_examples",
    "test_untrusted_run",
    "test_interruption",
    "test_docs",
    "test_bad_input",
    "test_recording_terminal",
    "test_teaching",
    "test_own_data",
    "test_report",
    "test_dashboard",
    "test_threads",
    "test_compare",
    "test_questions",
    "test_schemas",
    "test_experiment",
    "test_report_page",
)

settings.register_profile("koopdqn", derandomize=True, deadline=None)
settings.load_profile("koopdqn")


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "slow: learns a whole task; run by `make learn` alone")
    config.addinivalue_line("markers", "draws: needs OpenGL; skipped where its libraries are missing")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest modules; the Makefile keeps pytest-xdist from sorting them by their number of tests."""
    if os.environ.get("MUJOCO_GL") == "disable":
        for item in items:
            if item.get_closest_marker("draws"):
                item.add_marker(pytest.mark.skip(reason=NO_OPENGL))
    place = {name: number for number, name in enumerate(_LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))


@pytest.fixture(scope="session", autouse=True)
def read_once() -> Iterator[None]:
    """Let Hydra read its own configs and the package's, which stay as they are, once for all tests in this process."""
    from hydra._internal.sources_registry import SourcesRegistry
    from hydra.core.plugins import Plugins

    from koopdqn.resources import conf_dir

    def once(kind: Any) -> Callable[[Any, str], Any]:
        read, known = kind.load_config, dict[tuple[str, str, str], bytes]()

        def load(self: Any, config_path: str) -> Any:
            if self.path not in ("hydra.conf", str(conf_dir())):
                return read(self, config_path)
            key = self.path, self.provider, config_path
            if key not in known:
                known[key] = pickle.dumps(read(self, config_path))
            return pickle.loads(known[key])

        return load

    Plugins.instance()
    with pytest.MonkeyPatch.context() as patched:
        for scheme in ("file", "pkg"):
            kind = SourcesRegistry.instance().resolve(scheme)
            patched.setattr(kind, "load_config", once(kind))
        yield


@pytest.fixture(scope="module", autouse=True)
def undrawn(request: pytest.FixtureRequest) -> Iterator[None]:
    """Leave pictures blank in modules that ask for something else."""
    with pytest.MonkeyPatch.context() as patched:
        if request.module.__name__ in _UNDRAWN:
            from matplotlib.figure import Figure

            patched.setattr(Figure, "draw", lambda self, renderer: None)
        yield


@pytest.fixture(autouse=True)
def read_here(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Read recordings in this process where tests ask what is read; test_recording_bombs.py asks of the other one."""
    if request.module.__name__ in _READ_HERE:
        from koopdqn.demonstrations.recordings import load

        monkeypatch.setattr(load, "confined", lambda read, _seconds: read())


@pytest.fixture(scope="session")
def parts() -> "Parts":
    """The default config's parts."""
    from parts import load_parts

    return load_parts()


@pytest.fixture(scope="session")
def paper() -> "Parts":
    """The parts of the config under ``preset=paper``."""
    from parts import load_parts

    return load_parts("preset=paper")


@pytest.fixture(scope="session")
def arm(parts: "Parts") -> "URArm":
    return parts.arm


@pytest.fixture(scope="session")
def shelf_task(parts: "Parts") -> "ShelfTask":
    return parts.task


@pytest.fixture(scope="session")
def workcell(shelf_task: "ShelfTask", arm: "URArm") -> "Workcell":
    from koopdqn.tasks.workcell import open_workcell

    return open_workcell(shelf_task, arm)


@pytest.fixture(scope="session")
def scene(workcell: "Workcell") -> "Scene":
    return workcell.scene


@pytest.fixture(scope="session")
def motion(workcell: "Workcell") -> "Array":
    """Joint angles (N, 6) [rad] of the shelf's arm along the nominal path."""
    from koopdqn import pose

    points = workcell.task.nominal_path.points[::8]
    joints, reason = workcell.reachability.follow(pose.make(points, workcell.task.start_quaternion))
    assert joints is not None, reason
    return joints


@pytest.fixture(scope="session")
def demonstrations_of(workcell: "Workcell", parts: "Parts") -> "Callable[[int], Demonstrations]":
    """Five demonstrations of the shelf task by seed, each set generated once."""
    from functools import cache

    from koopdqn.demonstrations.generate import generate

    @cache
    def generated(seed: int) -> "Demonstrations":
        return generate(workcell.task, workcell.reachability, parts.demo, seed).demonstrations

    return generated


@pytest.fixture(scope="session")
def demonstrations(demonstrations_of: "Callable[[int], Demonstrations]") -> "Demonstrations":
    return demonstrations_of(0)


@pytest.fixture(scope="session")
def trajectories(demonstrations: "Demonstrations", shelf_task: "ShelfTask") -> "list[Array]":
    """The demonstrations' poses at the agent's step."""
    from koopdqn.intent.fit import agent_steps

    return agent_steps(demonstrations, shelf_task)


@pytest.fixture(scope="session")
def fitted(demonstrations: "Demonstrations", parts: "Parts") -> "Fitted":
    from koopdqn.intent.fit import fit

    return fit(demonstrations, parts.task, parts.intent, parts.trust, parts.reward)


@pytest.fixture(scope="session")
def reward(parts: "Parts", fitted: "Fitted") -> "IntentReward":
    from koopdqn.intent.reward import IntentReward

    return IntentReward(parts.task, fitted.model, fitted.trust, parts.reward)
