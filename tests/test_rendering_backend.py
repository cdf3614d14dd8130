import os
import subprocess
import sys

import pytest

from koopdqn.errors import BadInputError
from koopdqn.robot import VARIABLE, prepare_rendering


@pytest.fixture
def no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    for name in (VARIABLE, "DISPLAY", "WAYLAND_DISPLAY"):
        # Set first, so that whatever the function sets is undone after the test.
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)


@pytest.mark.parametrize(
    ("present", "expected"),
    [
        ({"libEGL.so.1", "libGL.so.1", "libOSMesa.so.8"}, "egl"),
        ({"libEGL.so.1", "libOSMesa.so.8"}, "osmesa"),
        ({"libOSMesa.so.6"}, "osmesa"),
        ({"libEGL.so.1"}, "disable"),
        (set(), "disable"),
    ],
)
@pytest.mark.usefixtures("no_display")
def test_without_a_display_the_first_backend_whose_libraries_load_is_chosen(present: set[str], expected: str) -> None:
    prepare_rendering(present.__contains__)
    assert os.environ[VARIABLE] == expected


@pytest.mark.usefixtures("no_display")
def test_a_display_leaves_the_choice_to_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":0")
    prepare_rendering(lambda library: True)
    assert VARIABLE not in os.environ


@pytest.mark.usefixtures("no_display")
def test_a_backend_that_is_asked_for_is_kept_or_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "osmesa")
    prepare_rendering(lambda library: True)
    assert os.environ[VARIABLE] == "osmesa"
    with pytest.raises(BadInputError, match=r"MUJOCO_GL must.*found 'osmesa' without libOSMesa.*koopdqn doctor"):
        prepare_rendering(lambda library: False)


def test_the_backend_is_chosen_before_mujoco_is_imported() -> None:
    code = "import sys, koopdqn.robot; assert 'mujoco' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
