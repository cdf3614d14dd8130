"""What of this machine works, and how to mend the rest: ``koopdqn doctor``."""

import json
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Final, Literal

from koopdqn import console
from koopdqn.errors import KoopdqnError

Status = Literal["ok", "warn", "fail"]

BACKENDS: Final = ("egl", "osmesa", "glfw")
"""Rendering backends of MuJoCo, in the order of preference without a display."""

_PACKAGES: Final = (
    *("mujoco", "dm-control", "dm-env", "torch", "numpy", "scipy", "h5py", "hydra-core", "omegaconf", "pydantic"),
    *("safetensors", "matplotlib", "tensorboard", "typer", "rich"),
)
_EXTRAS: Final = {
    "video": ("imageio", "imageio-ffmpeg"),
    "ros": ("rosbags",),
    "lerobot": ("pyarrow",),
    "rtde": ("ur-rtde",),
    "gym": ("gymnasium",),
    "analytic": ("eaik",),
}
_LEAST_FREE_BYTES: Final = 1_000_000_000
_PROBE_SECONDS: Final = 60.0
_MENDS: Final = {
    "egl": "Debian/Ubuntu: apt-get install libegl1 libopengl0 libgl1-mesa-dri",
    "osmesa": "Debian/Ubuntu: apt-get install libosmesa6",
    "glfw": "needs a display (DISPLAY or WAYLAND_DISPLAY)",
}
_MODEL: Final = """
import mujoco
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><light/><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_step(model, data)
"""
_STEP_PROBE: Final = f"""{_MODEL}
print("dropped a ball for", data.time, "s")
"""
_RENDER_PROBE: Final = f"""{_MODEL}
with mujoco.Renderer(model, 32, 32) as renderer:
    renderer.update_scene(data)
    assert renderer.render().any(), "the picture is black"
print("drew 32 x 32 pixels")
"""
_TORCH_PROBE: Final = "import torch; print(torch.get_num_threads())"


@dataclass(frozen=True)
class Check:
    """One finding.

    Attributes:
        name: what was looked at.
        status: "ok"; "warn" (something optional is missing, or could be better); "fail" (koopdqn needs it).
        found: what was found.
        mend: how to mend it; "" if there is nothing to mend.
    """

    name: str
    status: Status
    found: str
    mend: str = ""


def run(*, as_json: bool) -> int:
    """Examine the machine, print the findings, and return 0 if all that koopdqn needs works, else 1."""
    from rich.text import Text

    checks = examine()
    works = all(check.status != "fail" for check in checks)
    if as_json:
        print(json.dumps({"works": works, "checks": [asdict(check) for check in checks]}, indent=2))
        return 0 if works else 1
    styles = {"ok": "green", "warn": "yellow", "fail": "bold red"}
    headings = ("what", "", "found", "mend")
    rows = [(Text(c.name), Text(c.status, style=styles[c.status]), Text(c.found), Text(c.mend)) for c in checks]
    table = console.table(headings, rows, headings, box=None, pad_edge=False)
    for column in table.columns:
        column.overflow = "fold"
    console.say(table)
    console.say("Everything koopdqn needs works." if works else "Something koopdqn needs is missing; see above.")
    return 0 if works else 1


def examine() -> list[Check]:
    """Return the findings about this machine; rendering and MuJoCo are tried in processes of their own."""
    return [
        Check("Python", "ok", platform.python_version()),
        *check_packages(_version),
        _probed("MuJoCo simulates", _STEP_PROBE, "pip install --force-reinstall mujoco"),
        *check_rendering(probe),
        check_terminal(),
        _check_threads(),
        check_folder(Path.cwd()),
        *_check_resources(),
        check_extras(_version),
    ]


def probe(code: str, **environment: str) -> tuple[bool, str]:
    """Run Python code in a process of its own; return whether it worked and the last line it printed."""
    command = [sys.executable, "-c", code]
    variables = {**os.environ, **environment}
    try:
        done = subprocess.run(
            command, env=variables, capture_output=True, text=True, timeout=_PROBE_SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        return False, f"no answer within {_PROBE_SECONDS:.0f} s"
    except OSError as error:
        return False, str(error)
    if done.returncode < 0:
        return False, f"ended by signal {-done.returncode}"
    lines = (done.stdout if done.returncode == 0 else done.stderr).strip().splitlines()
    # errors raised while Python cleans up after the error proper come last and say nothing
    lines = [line for line in lines if re.match(r"\w*(Error|Exception)\b", line)] or lines
    return done.returncode == 0, lines[-1].strip() if lines else "nothing printed"


def _probed(name: str, code: str, mend: str) -> Check:
    works, line = probe(code)
    return Check(name, "ok", line) if works else Check(name, "fail", line, mend)


def check_packages(version: Callable[[str], str | None]) -> list[Check]:
    """Return whether the packages koopdqn needs are there, and mujoco is a release dm-control works with.

    ``version`` gives the version of an installed package, or None.
    """
    checks = []
    for name in _PACKAGES:
        found = version(name)
        if found is None:
            checks.append(Check(name, "fail", "not installed", f"pip install {name}"))
        elif name == "mujoco" and int(found.split(".")[0]) >= 4:
            checks.append(Check(name, "fail", f"{found}; dm-control needs mujoco < 4", "pip install 'mujoco>=3.17,<4'"))
        else:
            checks.append(Check(name, "ok", found))
    return checks


def check_rendering(run_probe: Callable[..., tuple[bool, str]]) -> list[Check]:
    """Return which rendering backends work by ``run_probe``, which is as `probe`, and which one koopdqn will use.

    Only pictures and films need one, so that none at all is a warning.
    """
    found = {backend: run_probe(_RENDER_PROBE, MUJOCO_GL=backend) for backend in BACKENDS}
    working = [backend for backend, (works, _) in found.items() if works]
    checks = []
    for backend, (works, line) in found.items():
        mend = "" if works else f"not needed: {working[0]} works" if working else _MENDS[backend]
        checks.append(Check(f"rendering: {backend}", "ok" if works else "warn", line, mend))
    asked = os.environ.get("MUJOCO_GL", "")
    if asked and asked not in working:
        mend = f"unset MUJOCO_GL, or set it to one of: {', '.join(working)}" if working else _MENDS["egl"]
        checks.append(Check("rendering", "warn", f"MUJOCO_GL={asked} is set and does not work", mend))
    elif not working:
        checks.append(Check("rendering", "warn", "no backend works: no pictures, no films", _MENDS["egl"]))
    else:
        checks.append(Check("rendering", "ok", f"koopdqn will use {asked or working[0]}"))
    return checks


def check_terminal() -> Check:
    """Return what the terminal can do; a run needs none unless a person answers its questions."""
    terminal = console.err()
    unicode = "Unicode" if terminal.encoding.lower().startswith("utf") else f"{terminal.encoding}: no Unicode"
    if not sys.stdin.isatty() or not terminal.is_terminal:
        mend = "only needed to answer questions yourself (ssh -t, docker run -it)"
        return Check("terminal", "warn", f"none, {unicode}", mend)
    size = shutil.get_terminal_size()
    found = f"{size.columns} x {size.lines}, {terminal.color_system or 'no colour'}, {unicode}"
    return Check("terminal", "ok", found)


def _check_threads() -> Check:
    """Return how many threads torch uses by itself, and the cores this process may use."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    check = _probed("torch threads", _TORCH_PROBE, "pip install --force-reinstall torch")
    return check if check.mend else Check(check.name, "ok", f"{check.found} by default, {cores} cores")


def check_folder(folder: Path) -> Check:
    """Return whether results can be written to ``folder`` and there is room for them."""
    name = "working folder"
    if not os.access(folder, os.W_OK | os.X_OK):
        return Check(name, "warn", f"{folder} is read-only", "work in another folder, or name one with out=DIR")
    free = shutil.disk_usage(folder).free
    found = f"can be written, {free / 1e9:.1f} GB free"
    if free < _LEAST_FREE_BYTES:
        return Check(name, "warn", found, "make room: a run takes up to a few hundred megabytes")
    return Check(name, "ok", found)


def _check_resources() -> list[Check]:
    """Return whether the config tree and the assets are installed."""
    from koopdqn.resources import assets_dir, conf_dir

    checks = []
    for name, find in (("conf", conf_dir), ("assets", assets_dir)):
        try:
            checks.append(Check(name, "ok", str(find())))
        except KoopdqnError as error:
            checks.append(Check(name, "fail", str(error), "pip install --force-reinstall koopdqn"))
    return checks


def check_extras(version: Callable[[str], str | None]) -> Check:
    """Return which extras are installed, given the version of an installed package, or None."""
    found = {extra: all(map(version, packages)) for extra, packages in _EXTRAS.items()}
    there, absent = ([extra for extra, have in found.items() if have is which] for which in (True, False))
    mend = f"pip install 'koopdqn[{','.join(absent)}]', or those of them that you need" if absent else ""
    return Check("extras (optional)", "ok", ", ".join(there) or "none", mend)


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None
