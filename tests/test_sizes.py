"""What `make sizes` measures, on a package small enough to count by hand."""

from pathlib import Path
from typing import Any

import grimp
import pytest
import sizes

LAYERS = ["top", "middle : beside", "bottom"]
LIMITS: dict[str, Any] = {"lines": 10, "modules": 9, "rooms": {"middle": 2}}


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder on the path that holds the package ``house`` of four layers' rooms, one module in each."""
    house = tmp_path / "house"
    for room, content in {"top": "from house.middle import a\n", "middle": "", "beside": "", "bottom": ""}.items():
        (house / room).mkdir(parents=True)
        (house / room / "__init__.py").touch()
        (house / room / "a.py").write_text(content)
    (house / "__init__.py").write_text('"""A house."""\n')
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def graph() -> grimp.ImportGraph:
    return grimp.build_graph("house", cache_dir=None)


def test_lines_and_modules_are_counted_by_room_in_the_order_of_the_layers(root: Path) -> None:
    (root / "house" / "middle" / "a.py").write_text("A = 1\n\nB = 2\n")
    *rooms, whole = sizes.measured(root / "house", LAYERS, LIMITS)
    assert [(row.name, row.lines, row.modules) for row in rooms] == [
        ("top", 1, 2),
        ("beside", 0, 2),
        ("middle", 3, 2),
        ("bottom", 0, 2),
        ("*.py", 1, 1),
    ]
    assert (whole.lines, whole.modules) == (5, 9)
    assert [row.name for row in (*rooms, whole) if not row.holds] == ["middle"]


def test_imports_that_run_downwards_or_beside_are_no_fault(root: Path) -> None:
    (root / "house" / "middle" / "a.py").write_text("from house.beside import a\nfrom house.bottom import a as b\n")
    assert sizes.upward(graph(), "house", LAYERS) == []
    assert sizes.circular(graph()) == []


def test_an_upward_import_is_named_even_where_it_closes_no_circle(root: Path) -> None:
    (root / "house" / "bottom" / "a.py").write_text("from house.beside import a\n")
    assert sizes.upward(graph(), "house", LAYERS) == [("house.bottom.a", "house.beside.a")]
    assert sizes.circular(graph()) == []


def test_a_circle_within_a_room_is_named_by_an_import_that_closes_it(root: Path) -> None:
    (root / "house" / "bottom" / "a.py").write_text("from house.bottom import b\n")
    (root / "house" / "bottom" / "b.py").write_text("from house.bottom import a\n")
    pair = ("house.bottom.a", "house.bottom.b")
    assert sizes.circular(graph()) in ([pair], [pair[::-1]])
    assert sizes.upward(graph(), "house", LAYERS) == []


@pytest.mark.parametrize(("lines", "modules", "holds"), [(10, 9, True), (11, 9, False), (10, 10, False)])
def test_a_limit_is_the_most_that_is_allowed(lines: int, modules: int, holds: bool) -> None:
    assert sizes.Row("all", lines, modules, 10, 9).holds is holds


@pytest.mark.parametrize(("most", "status"), [(10**6, 0), (1, 1)])
def test_the_command_fails_on_a_limit_exceeded_only_where_told_to_check(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], most: int, status: int
) -> None:
    monkeypatch.setattr(sizes, "shown", lambda rows: f"{len(rows)} rows")
    row = sizes.Row("all", 2, 2, most, most)
    monkeypatch.setattr(sizes, "measured", lambda *given: [row])
    assert sizes.main(["--check"]) == status
    assert sizes.main([]) == 0
    told = capsys.readouterr().out
    assert told.count("1 rows\nimports that close a circle: 0\nupward imports: 0\n") == 2
