"""The packaging gate: build what users get, install it as they would, and use it away from the checkout.

Builds the sdist, then the wheel from the sdist, into ``dist/``; compares their contents with the
checkout; installs the wheel into a new virtual environment with the pinned dependencies; and there, in
an empty folder, runs the program, composes every option of every config group and loads every MJCF.
The variable CONSTRAINTS names another file of pins; empty, the newest allowed releases are installed.

Run it as ``make package``. Exit status 0 if everything holds, 1 at the first step that finds a fault.
"""

import email.message
import email.parser
import hashlib
import json
import os
import subprocess
import sys
import tarfile
import tempfile
import time
import tomllib
import venv
import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
DIST = ROOT / "dist"

# Folders in the sdist, and where the wheel holds those that it takes.
SDIST_FOLDERS = ("assets", "conf", "docs", "examples", "koopdqn", "scripts", "tests")
WHEEL_FOLDERS = {"koopdqn": "koopdqn", "conf": "koopdqn/conf", "assets": "koopdqn/assets"}
SDIST_FILES = frozenset(
    {
        ".gitignore",  # hatchling adds it, to build the same wheel from the sdist
        "CHANGELOG.md",
        "CITATION.cff",
        "CONTRIBUTING.md",
        "LICENSE",
        "Makefile",
        "PKG-INFO",
        "README.md",
        "SECURITY.md",
        "constraints.txt",
        "mkdocs.yml",
        "pyproject.toml",
    }
)
DIST_INFO_FILES = ("METADATA", "RECORD", "WHEEL", "entry_points.txt", "licenses/LICENSE")


class GateError(Exception):
    """The package breaks a rule; the message names the rule and what was found."""


@contextmanager
def step(name: str) -> Iterator[None]:
    """Print the name of a step before it, and the seconds it took after it."""
    began = time.monotonic()
    print(f"  {name} ...", end=" ", flush=True)
    yield
    print(f"{time.monotonic() - began:.1f} s", flush=True)


def run(*command: str | Path, cwd: Path, env: dict[str, str] | None = None) -> str:
    """Run a command without input and return its standard output.

    Raises:
        GateError: it ended with another status than 0; the message holds the end of what it printed.
    """
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=env,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        printed = "\n".join((done.stdout + done.stderr).strip().splitlines()[-25:])
        shown = " ".join([Path(command[0]).name, *map(str, command[1:])])
        raise GateError(f"`{shown}` ended with status {done.returncode}:\n{printed}")
    return done.stdout


def sealed(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of a build, whose files bear one date: SOURCE_DATE_EPOCH, else the last commit's."""
    told = environment.get("SOURCE_DATE_EPOCH")
    if not told:
        done = subprocess.run(
            ["git", "log", "-1", "--format=%ct"], cwd=ROOT, capture_output=True, text=True, check=False
        )
        # An unpacked sdist has no commits.
        told = done.stdout.strip() or "1580601600"
    return {**environment, "SOURCE_DATE_EPOCH": told}


def check_again(*archives: Path) -> None:
    """Build sdist and wheel once more, from another folder, and compare the bytes.

    Raises:
        GateError: the build failed, or an archive has other bytes.
    """
    # The date of the commit, which the unpacked sdist does not know.
    environment = sealed(os.environ)
    with tempfile.TemporaryDirectory(prefix="koopdqn-again-") as folder:
        unpacked = Path(folder) / "unpacked"
        with tarfile.open(archives[0]) as sdist:
            sdist.extractall(unpacked, filter="data")
        (source,) = unpacked.iterdir()
        out = Path(folder) / "out"
        run(sys.executable, "-m", "build", "--no-isolation", "--outdir", out, cwd=source, env=environment)
        for archive in archives:
            sums = [hashlib.sha256(path.read_bytes()).hexdigest() for path in (archive, out / archive.name)]
            if sums[0] != sums[1]:
                raise GateError(f"{archive.name} must have the same bytes when it is built again, found {sums}")


def build(version: str) -> tuple[Path, Path]:
    """Build the sdist, and from it the wheel, into an emptied ``dist/``; return the paths of both.

    Raises:
        GateError: the build failed, or left other files than these two.
    """
    for old in DIST.glob("koopdqn-*"):
        old.unlink()
    # The backend is in the development environment, pinned; an isolated build would fetch it anew.
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", DIST, cwd=ROOT, env=sealed(os.environ))
    sdist, wheel = DIST / f"koopdqn-{version}.tar.gz", DIST / f"koopdqn-{version}-py3-none-any.whl"
    found = sorted(DIST.glob("koopdqn-*"))
    if found != sorted([sdist, wheel]):
        raise GateError(f"the build must leave {sdist.name} and {wheel.name}; found {[path.name for path in found]}")
    return sdist, wheel


def checkout_files(folder: str) -> set[str]:
    """Return the paths below a folder of the checkout, relative to that folder, without compiled Python."""
    top = ROOT / folder
    return {
        path.relative_to(top).as_posix()
        for path in top.rglob("*")
        if path.is_file() and "__pycache__" not in path.relative_to(top).parts
    }


def compare(archive: str, found: set[str], expected: set[str]) -> None:
    """Check that an archive holds exactly the expected files.

    Raises:
        GateError: files are missing, or files are there that do not belong.
    """
    faults = []
    if missing := sorted(expected - found):
        faults.append(f"lacks {', '.join(missing)}")
    if foreign := sorted(found - expected):
        faults.append(f"holds what does not belong: {', '.join(foreign)}")
    if faults:
        raise GateError(f"{archive} " + "; it ".join(faults))


def check_sdist(sdist: Path, version: str) -> None:
    """Check that the sdist holds the source folders and top-level files of the checkout, and no more.

    Raises:
        GateError: it does not.
    """
    with tarfile.open(sdist) as archive:
        found = {member.name.removeprefix(f"koopdqn-{version}/") for member in archive if member.isfile()}
    below = {f"{folder}/{name}" for folder in SDIST_FOLDERS for name in checkout_files(folder)}
    for folder in ("assets", "conf", "tests"):
        if not any(name.startswith(f"{folder}/") for name in below):
            raise GateError(f"the folder {folder}/ of the checkout must hold files; it is empty")
    compare(sdist.name, found, below | SDIST_FILES)


def check_wheel(wheel: Path, project: dict[str, Any]) -> None:
    """Check the files and the metadata of the wheel against the checkout and ``pyproject.toml``.

    Raises:
        GateError: a file is missing or too many, or a metadata field differs.
    """
    info = f"koopdqn-{project['version']}.dist-info"
    with zipfile.ZipFile(wheel) as archive:
        found = {name for name in archive.namelist() if not name.endswith("/")}
        metadata = email.parser.Parser().parsestr(archive.read(f"{info}/METADATA").decode())
        entry_points = archive.read(f"{info}/entry_points.txt").decode()
    expected = {f"{there}/{name}" for here, there in WHEEL_FOLDERS.items() for name in checkout_files(here)}
    compare(wheel.name, found, expected | {f"{info}/{name}" for name in DIST_INFO_FILES})
    if "koopdqn/py.typed" not in found:
        raise GateError(f"{wheel.name} must hold koopdqn/py.typed, so that users' type checkers read our types")
    if "koopdqn = koopdqn.app.cli:main" not in entry_points:
        raise GateError(f"the entry point must be `koopdqn = koopdqn.app.cli:main`; found {entry_points.strip()!r}")
    check_metadata(metadata, project)


def check_metadata(metadata: email.message.Message, project: dict[str, Any]) -> None:
    """Check the fields of a wheel's METADATA against the ``project`` table of ``pyproject.toml``.

    Raises:
        GateError: a field differs.
    """
    single = {
        "Name": project["name"],
        "Version": project["version"],
        "Summary": project["description"],
        "Requires-Python": project["requires-python"],
        "License-Expression": "Apache-2.0",
        "License-File": "LICENSE",
        "Description-Content-Type": "text/markdown",
    }
    for field, value in single.items():
        if metadata[field] != value:
            raise GateError(f"the metadata field {field} must be {value!r}; found {metadata[field]!r}")
    extras = set(metadata.get_all("Provides-Extra", []))
    if extras != set(project["optional-dependencies"]):
        raise GateError(f"the extras must be {sorted(project['optional-dependencies'])}; found {sorted(extras)}")
    needs = [need for need in metadata.get_all("Requires-Dist", []) if "extra ==" not in need]
    if len(needs) != len(project["dependencies"]):
        raise GateError(f"the wheel must need {len(project['dependencies'])} packages; found {needs}")


class Installation:
    """The wheel, installed alone into a new virtual environment, and an empty folder to use it in."""

    def __init__(self, folder: Path, wheel: Path) -> None:
        """Make the environment below ``folder``, an existing empty folder, and install the ``wheel`` into it.

        Raises:
            GateError: the wheel or one of its dependencies cannot be installed, or they contradict each other.
        """
        self.environment = folder / "venv"
        self.work = folder / "work"
        self.work.mkdir()
        venv.create(self.environment, with_pip=True)
        self.bin = self.environment / "bin"
        # What the caller's shell says of Python must not reach the checkout or the caller's environment.
        self.env = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}
        constraints = os.environ.get("CONSTRAINTS", "constraints.txt")
        pins = ["-c", str(ROOT / constraints)] if constraints else []
        self.python("-m", "pip", "install", "-qq", "--disable-pip-version-check", *pins, str(wheel))
        self.python("-m", "pip", "--disable-pip-version-check", "check")

    def python(self, *arguments: str) -> str:
        """Run the environment's Python in the empty folder and return its standard output."""
        return run(self.bin / "python", *arguments, cwd=self.work, env=self.env)

    def koopdqn(self, *arguments: str) -> str:
        """Run the installed program in the empty folder and return its standard output."""
        return run(self.bin / "koopdqn", *arguments, cwd=self.work, env=self.env)

    def package(self) -> Path:
        """Return the folder of the installed package.

        Raises:
            GateError: another copy than the installed one is imported.
        """
        found = Path(self.python("-c", "import koopdqn; print(koopdqn.__file__)").strip()).resolve().parent
        if not found.is_relative_to(self.environment.resolve()):
            raise GateError(f"koopdqn must be imported from the clean environment; it came from {found}")
        return found


def check_program(installation: Installation, version: str) -> None:
    """Check what the installed program says of itself and of the machine.

    Raises:
        GateError: an answer is wrong.
    """
    help_text = installation.koopdqn("--help")
    for command in ("demo", "fit", "train", "eval", "doctor"):
        if command not in help_text:
            raise GateError(f"`koopdqn --help` must name the command {command}; it printed:\n{help_text}")
    printed = installation.koopdqn("--version").strip()
    if version not in printed.split():
        raise GateError(f"`koopdqn --version` must print {version}; it printed {printed!r}")
    printed = installation.koopdqn("doctor", "--json")
    try:
        report = json.loads(printed)
    except ValueError as error:
        raise GateError(f"`koopdqn doctor --json` must print JSON and nothing else: {error}") from error
    if not isinstance(report, dict):
        raise GateError(f"`koopdqn doctor --json` must print a JSON object; found {type(report).__name__}")


def check_config(installation: Installation, conf: Path) -> int:
    """Compose the config with every option of every group and return how many there were.

    Raises:
        GateError: there is no option, or one does not compose.
    """
    options = sorted(
        f"{path.parent.relative_to(conf).as_posix()}={path.stem}"
        for path in conf.rglob("*.yaml")
        if path.parent != conf
    )
    if not options:
        raise GateError("the installed package must hold config groups; found none below koopdqn/conf")
    with ThreadPoolExecutor(max_workers=2) as pool:
        composed = pool.map(lambda option: installation.koopdqn("train", "--cfg", "job", option), options)
        for option, text in zip(options, composed, strict=True):
            if not text.strip():
                raise GateError(f"`koopdqn train --cfg job {option}` must print the config; it printed nothing")
    return len(options)


def check_models(installation: Installation, assets: Path) -> int:
    """Compile every MJCF model with MuJoCo and return how many there were.

    Raises:
        GateError: there is no model, or one does not compile.
    """
    # Files that are only included by others have another root element and cannot stand alone.
    models = sorted(path for path in assets.rglob("*.xml") if ElementTree.parse(path).getroot().tag == "mujoco")
    if not models:
        raise GateError("the installed package must hold MJCF models; found none below koopdqn/assets")
    code = "import sys, mujoco\nfor path in sys.argv[1:]: mujoco.MjModel.from_xml_path(path)"
    installation.python("-c", code, *map(str, models))
    return len(models)


def check_demo(installation: Installation) -> None:
    """Make one demonstration in the empty folder, and check where it went.

    Raises:
        GateError: the command failed or left no demonstrations file.
    """
    installation.koopdqn("demo", "task=shelf", "demo.count=1")
    made = sorted(path.relative_to(installation.work).as_posix() for path in installation.work.rglob("*.hdf5"))
    if len(made) != 1 or not made[0].startswith("runs/"):
        raise GateError(f"`koopdqn demo` must leave one demos.hdf5 below runs/; found {made}")


def main() -> int:
    """Run the gate and return its exit status."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    version = project["version"]
    try:
        with step("build the sdist, and the wheel from it"):
            sdist, wheel = build(version)
        with step("the same bytes again, from the sdist"):
            check_again(sdist, wheel)
        with step("contents and metadata"):
            check_sdist(sdist, version)
            check_wheel(wheel, project)
        with tempfile.TemporaryDirectory(prefix="koopdqn-package-") as folder:
            with step("install into a clean environment"):
                installation = Installation(Path(folder), wheel)
                package = installation.package()
            with step("--help, --version, doctor"):
                check_program(installation, version)
            with step("every config option"):
                options = check_config(installation, package / "conf")
            with step("every MJCF model"):
                models = check_models(installation, package / "assets")
            with step("a demonstration"):
                check_demo(installation)
    except GateError as error:
        print(f"failed\npackaging gate: {error}", file=sys.stderr)
        return 1
    print(f"packaging gate passed: {options} config options, {models} MJCF models, {sdist.name}, {wheel.name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
