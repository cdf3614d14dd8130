"""Files that say the same thing of the project say it alike."""

import re
import tomllib
from pathlib import Path

import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_version_cited_is_the_packages() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == PROJECT["version"]
    assert citation["license"] == PROJECT["license"]


def test_ci_runs_every_python_that_is_said_to_be_supported() -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())
    jobs = workflow["jobs"]["check"]["strategy"]["matrix"]["include"]
    passing = [job for job in jobs if not job.get("may_fail")]
    named = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
    assert [job["python"] for job in passing if job["dependencies"] == "pinned"] == named
    assert [job["python"] for job in passing if job["dependencies"] == "newest"] == named[-1:]
    assert PROJECT["requires-python"] == f">={named[0]}"


def test_what_make_setup_installs_is_pinned_within_its_bounds() -> None:
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    pins = {canonicalize_name(name): version for name, version in (line.split("==") for line in lines)}
    extras = PROJECT["optional-dependencies"]
    groups = [PROJECT["dependencies"], extras["dev"], extras["docs"], extras["video"]]
    wanted = [Requirement(text) for group in groups for text in group if not text.startswith("koopdqn[")]
    found = {str(wish): pins.get(canonicalize_name(wish.name)) for wish in wanted}
    assert {text: version for text, version in found.items() if version is None} == {}
    assert [str(wish) for wish in wanted if not wish.specifier.contains(found[str(wish)] or "")] == []
