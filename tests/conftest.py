"""What every test shares: off-screen rendering, the marker of slow tests, reproducible examples."""

import os
import sys

import pytest
from hypothesis import settings

# MuJoCo reads this once, at its first import; unset it means GLFW, which needs a display.
if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
    os.environ.setdefault("MUJOCO_GL", "egl")

settings.register_profile("koopdqn", derandomize=True, deadline=None)
settings.load_profile("koopdqn")


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "slow: learns a whole task; run by `make learn` alone")
