"""The robot: what an arm is, its kinematics, the scene it stands in, and how MuJoCo draws it."""

import ctypes
import os
import sys
from collections.abc import Callable
from typing import Final

from koopdqn.errors import BadInputError, unknown_name

VARIABLE: Final = "MUJOCO_GL"
DISABLED: Final = "disable"
_BACKENDS: Final = ("egl", "glfw", "osmesa", DISABLED)
# Other spellings that MuJoCo and dm_control both take.
_SYNONYMS: Final = ("disabled", "off", "false", "0", "enable", "enabled", "on", "true", "1")

# Of each inner tuple one library must load; without them `import mujoco` fails, not only drawing.
_LIBRARIES: Final = {
    "egl": (("libEGL.so.1",), ("libOpenGL.so.0", "libGL.so.1")),
    "osmesa": (("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"),),
}


def prepare_rendering(loads: Callable[[str], bool] | None = None) -> None:
    """Choose a backend that needs no display, where there is none; call it before anything imports mujoco.

    On Linux without a display, and with MUJOCO_GL unset, it sets MUJOCO_GL to the first of ``egl`` and
    ``osmesa`` whose libraries load, else to ``disable``, so that all but pictures works.

    Args:
        loads: whether a shared library of that name can be loaded; None tries it.

    Raises:
        BadInputError: MUJOCO_GL names no backend, or one whose libraries cannot be loaded.
    """
    if sys.platform != "linux":
        return
    loads = loads or _loads
    asked = os.environ.get(VARIABLE, "").strip().lower()
    if asked:
        if asked not in _BACKENDS + _SYNONYMS:
            raise unknown_name(f"rendering backend {VARIABLE}", asked, _BACKENDS)
        # dm_control takes lower case only
        os.environ[VARIABLE] = asked
        missing = _missing(asked, loads)
        if missing:
            raise BadInputError(
                f"{VARIABLE} must name a rendering backend whose libraries load, found {asked!r} without {missing};"
                " unset it, or see `koopdqn doctor`"
            )
        return
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return
    working = (name for name in _LIBRARIES if not _missing(name, loads))
    os.environ[VARIABLE] = next(working, DISABLED)


def _missing(backend: str, loads: Callable[[str], bool]) -> str:
    """Return the libraries that a backend lacks, for people; empty if none."""
    lacking = [names[0] for names in _LIBRARIES.get(backend, ()) if not any(map(loads, names))]
    return " and ".join(lacking)


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


# MuJoCo chooses how it draws at its first import, which is in a module of this package.
prepare_rendering()
