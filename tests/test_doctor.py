import json
from pathlib import Path

import pytest

from koopdqn.app import cli, doctor
from koopdqn.app.doctor import Check


def by_name(checks: list[Check]) -> dict[str, Check]:
    return {check.name: check for check in checks}


@pytest.mark.parametrize(("version", "status"), [("3.17.0", "ok"), ("4.0.0", "fail"), ("10.1", "fail"), (None, "fail")])
def test_mujoco_must_be_a_release_that_dm_control_works_with(version: str | None, status: str) -> None:
    checks = by_name(doctor.check_packages(lambda name: version if name == "mujoco" else "1.0"))
    assert checks["mujoco"].status == status
    assert checks["torch"].status == "ok"


@pytest.mark.parametrize(
    ("working", "asked", "status", "expected"),
    [
        ({"egl", "osmesa"}, "", "ok", "koopdqn will use egl"),
        ({"osmesa"}, "", "ok", "koopdqn will use osmesa"),
        ({"egl", "osmesa"}, "osmesa", "ok", "koopdqn will use osmesa"),
        ({"osmesa"}, "egl", "warn", "MUJOCO_GL=egl is set and does not work"),
        (set(), "", "warn", "no backend works: no pictures, no films"),
    ],
)
def test_the_backend_used_is_the_one_asked_for_or_the_first_that_works(
    monkeypatch: pytest.MonkeyPatch, working: set[str], asked: str, status: str, expected: str
) -> None:
    monkeypatch.setenv("MUJOCO_GL", asked)
    checks = doctor.check_rendering(lambda code, MUJOCO_GL: (MUJOCO_GL in working, "tried"))  # noqa: N803 - the variable's name
    found = by_name(checks)
    assert (found["rendering"].status, found["rendering"].found) == (status, expected)
    for backend in doctor.BACKENDS:
        assert (found[f"rendering: {backend}"].status == "ok") == (backend in working)


def test_whatever_does_not_work_says_how_to_mend_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    checks = [
        *doctor.check_packages(lambda name: None),
        *doctor.check_rendering(lambda code, **variables: (False, "no")),
        doctor.check_extras(lambda name: None),
        doctor.check_terminal(),
    ]
    assert all(check.mend for check in checks if check.status != "ok")


def test_an_extra_is_there_with_all_of_its_packages() -> None:
    check = doctor.check_extras({"imageio": "2", "rosbags": "1"}.get)
    assert check.found == "ros"
    assert check.mend.startswith("pip install 'koopdqn[video,lerobot,rtde,gym,analytic]'")


def test_a_probe_reports_the_last_line_an_error_or_a_signal(monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor.probe("print('a'); print('b')") == (True, "b")
    assert doctor.probe("import os; print(os.environ['COLOUR'])", COLOUR="red") == (True, "red")
    assert doctor.probe("raise ValueError('no')") == (False, "ValueError: no")
    assert doctor.probe("import os; os.abort()") == (False, "ended by signal 6")
    monkeypatch.setattr(doctor, "_PROBE_SECONDS", 0.2)
    works, line = doctor.probe("import time; time.sleep(30)")
    assert not works
    assert line.startswith("no answer within")


def test_a_full_disk_and_a_read_only_folder_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor.check_folder(tmp_path).status in ("ok", "warn")
    monkeypatch.setattr("shutil.disk_usage", lambda folder: type("Usage", (), {"free": 10})())
    assert "make room" in doctor.check_folder(tmp_path).mend
    monkeypatch.setattr("os.access", lambda path, mode: False)
    assert "out=DIR" in doctor.check_folder(tmp_path).mend


@pytest.mark.parametrize(("status", "exit_status"), [("ok", 0), ("warn", 0), ("fail", 1)])
def test_only_what_is_required_decides_the_exit_status(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], status: doctor.Status, exit_status: int
) -> None:
    check = Check("thing", status, "[found]", "pip install 'koopdqn[video]'")
    monkeypatch.setattr(doctor, "examine", lambda: [check])
    assert cli.main(["doctor", "--json"]) == exit_status
    report = json.loads(capsys.readouterr().out)
    assert report["works"] == (exit_status == 0)
    assert report["checks"] == [
        {"name": "thing", "status": status, "found": "[found]", "mend": "pip install 'koopdqn[video]'"}
    ]
    assert cli.main(["doctor"]) == exit_status
    table = capsys.readouterr().out
    assert "[found]" in table
    assert "koopdqn[video]" in " ".join(table.split())


def test_this_machine_is_examined(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "probe", lambda code, **variables: (True, "2"))
    names = [check.name for check in doctor.examine()]
    assert len(names) == len(set(names))
    assert {"Python", "mujoco", "MuJoCo simulates", "rendering", "terminal", "torch", "conf", "assets"} <= set(names)
