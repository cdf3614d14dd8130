import json
import re
from dataclasses import dataclass
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from report_runs import first, write_evaluation, write_run

from koopdqn import console
from koopdqn.app import cli
from koopdqn.app.commands import report
from koopdqn.app.commands.report import all_presets
from koopdqn.files import read_json
from koopdqn.report.figures import Figure
from koopdqn.report.page import Section, build, render, work_units
from koopdqn.report.runs import DEFAULT, find_runs, group_runs
from koopdqn.report.schema import MissingPart, ReportFile
from koopdqn.report.tables import Cell, Table

if TYPE_CHECKING:
    from parts import Parts

    from koopdqn.demonstrations.dataset import Demonstrations
    from koopdqn.report.runs import Groups, Presets

VOID = {"meta", "img"}


class Reader(HTMLParser):
    """Reads a page and checks that every element is closed where it should be."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.images: list[str] = []
        self.names: set[str] = set()
        self.text = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.names.add(tag)
        if tag not in VOID:
            self.open.append(tag)
        for name, value in attributes:
            {"id": self.ids, "href": self.links, "src": self.images}.get(name, []).append(value or "")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1:] != ["style"]:
            self.text += data


def page(title: str, sections: list[Section], folder: Path) -> str:
    return render(title, sections, folder, sweep=Path("runs"))


def png(folder: Path, name: str) -> str:
    Image.fromarray(np.zeros((2, 3, 3), dtype=np.uint8)).save(folder / name)
    return name


def test_a_page_holds_everything_it_shows(tmp_path: Path) -> None:
    sources = (tmp_path / "runs" / "a b" / "train.json", tmp_path / "runs" / "c" / "train.json")
    for source in sources:
        source.parent.mkdir(parents=True)
        source.touch()
    figure = Figure("4, left", "Errors", "at most 2 mm", [png(tmp_path, "a.png")], sources[:1])
    table = Table("Numbers", ("what", "value"), [(Cell("seeds"), Cell("3", sources))])
    sections = [Section("First part", [figure, table], ["with `code`"]), Section("Second: part", [figure])]
    reader = Reader(page("Title", sections, tmp_path))
    inner = [link[1:] for link in reader.links if link.startswith("#")]
    assert len(inner) == 2
    assert set(inner) <= set(reader.ids)
    files = [link for link in reader.links if not link.startswith("#")]
    assert files == ["runs/a%20b/train.json", "runs/a%20b/train.json", "runs/c/train.json", "runs/a%20b/train.json"]
    assert all(image.startswith("data:image/png;base64,") for image in reader.images)
    assert not reader.names & {"script", "link", "iframe"}


def test_a_page_reaches_for_nothing_outside(tmp_path: Path) -> None:
    figure = Figure("1", "t", "c", [png(tmp_path, "a.png")])
    assert not re.search(r"https?://|@import|url\(", page("Title", [Section("Part", [figure])], tmp_path))


def test_pictures_of_one_figure_and_halves_stand_side_by_side(tmp_path: Path) -> None:
    one, two = png(tmp_path, "a.png"), png(tmp_path, "b.png")
    figures = [Figure("1", "t", "c", [one, two]), *(Figure(n, "t", "c", [one], layout="half") for n in ("7", "8"))]
    text = page("Title", [Section("Part", figures)], tmp_path)
    assert re.findall(r'<figure id="([^"]*)" class="([^"]*)">', text) == [
        ("figure-1", "pair"),
        ("figure-7", "half"),
        ("figure-8", "half"),
    ]


def test_what_is_missing_says_what_makes_it(tmp_path: Path) -> None:
    blocks = [
        MissingPart(what="Figure 2", reason="It needs a run.", command="koopdqn train task=shelf"),
        MissingPart(what="Figure 3", reason="It cannot be."),
    ]
    text = page("Title", [Section("Part", blocks)], tmp_path)
    assert "<code>koopdqn train task=shelf</code> makes it." in text
    assert text.count("makes it.") == 1


@given(st.text(st.characters(exclude_characters="`\r", exclude_categories=("Cs", "Cc")), min_size=1))
def test_any_text_is_shown_as_it_is(text: str) -> None:
    def everywhere(text: str) -> Reader:
        block = MissingPart(what=text, reason=text, command=text)
        table = Table(text, (text,), [(Cell(text),)])
        figure = Figure(text, text, text, [])
        return Reader(page(text, [Section(text, [block, table, figure], [text])], Path()))

    reader = everywhere(text)
    # No element comes out of a text.
    assert reader.names == everywhere("a").names
    assert unescape(reader.text).count(text) >= 14


@pytest.mark.parametrize("count", [0, 1, 3])
def test_a_cell_links_to_each_of_its_sources(tmp_path: Path, count: int) -> None:
    sources = tuple(tmp_path / f"{index}.json" for index in range(count))
    table = Table("t", ("a", "b"), [(Cell("row"), Cell("42", sources))])
    reader = Reader(page("Title", [Section("Part", [table])], tmp_path))
    assert [link for link in reader.links if link.endswith(".json")] == [source.name for source in sources]


def test_a_row_that_sums_up_others_is_marked(tmp_path: Path) -> None:
    table = Table("t", ("a",), [(Cell("one"),), (Cell("mean"),)], summaries=[1])
    text = page("Title", [Section("Part", [table])], tmp_path)
    assert re.findall(r'<tr class="summary"><th scope="row">(\w+)', text) == ["mean"]


@pytest.fixture(scope="module")
def presets() -> "Presets":
    return all_presets()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, parts: "Parts", demonstrations: "Demonstrations") -> Path:
    """Finished runs of the shelf with two seeds, one of them evaluated."""
    root = tmp_path_factory.mktemp("finished")
    for seed in range(2):
        write_run(root / f"run{seed}", parts, first(demonstrations, 2), seed)
    write_evaluation(root / "eval", parts, str(root / "run0"))
    return root


@pytest.fixture(scope="module")
def groups(folder: Path, presets: "Presets") -> "Groups":
    return group_runs(find_runs([folder])[0], presets)[0]


@dataclass(frozen=True)
class Built:
    """A report: its folder, the content of its JSON, and how many units of work it told of."""

    folder: Path
    content: dict[str, Any]
    told: int


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory, folder: Path) -> Built:
    """The report of those runs, made through the command line."""
    work = tmp_path_factory.mktemp("work")
    told: list[None] = []

    def counted(
        groups: Any, presets: Any, intents: Any, left_out: Any, ablations: Path, folder: Path, _: object
    ) -> dict[str, Any]:
        return build(groups, presets, intents, left_out, ablations, folder, lambda: told.append(None))

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(work)
        patch.setattr(report, "build", counted)
        for stream in (console.out, console.err):
            stream.cache_clear()
        assert cli.main(["report", f"report.runs=[{folder}]", "out=made"]) == 0
    where = work / "made" / "report"
    return Built(where, read_json(where / "report.json", "the report"), len(told))


@pytest.mark.draws
def test_the_report_says_what_it_shows_and_what_it_lacks(built: Built, folder: Path) -> None:
    content = ReportFile.model_validate(built.content)
    assert [(run.task, run.preset, run.seed) for run in content.runs] == [("shelf", DEFAULT, 0), ("shelf", DEFAULT, 1)]
    assert [run.evaluation for run in content.runs] == [str(folder / "eval" / "eval.json"), None]
    assert [figure.number for figure in content.figures] == ["1", "2", "3", "4, left", "4, right", "5"]
    for figure in content.figures:
        for name in figure.files:
            assert (built.folder / name).read_bytes().startswith(b"\x89PNG")
    lacking = {part.what: part.command for part in content.missing}
    assert set(lacking) == {"The table of ablations"} | {
        f"Figure {n}" for n in ("6, left", "6, right", "7", "8", "9, left", "9, right")
    }
    assert lacking.pop("The table of ablations") == "make ablations"
    assert all(command.startswith("koopdqn train") for command in lacking.values())
    assert all("task=knife" in command for command in lacking.values())


def test_all_work_is_told(built: Built, groups: "Groups") -> None:
    assert built.told == work_units(groups)


def test_every_link_of_the_page_leads_to_a_file(built: Built) -> None:
    where, content = built.folder, built.content
    text = (where / "report.html").read_text(encoding="utf-8")
    links = set(re.findall(r'href="([^#"][^"]*)"', text))
    assert len(links) > 8
    for link in links:
        assert (where / unquote(link)).exists(), link
    assert text.count("data:image/png;base64,") == sum(len(figure["files"]) for figure in content["figures"])


def test_the_fits_that_tables_quote_are_kept(built: Built) -> None:
    for name in ("paper", "pose", "line", "joint"):
        kept = json.loads((built.folder / "fits" / f"shelf-{name}.json").read_text())
        assert kept["fit"]["intent"] == name
        assert len(kept["held_out"]["sixty_samples_error_m"]) == 59


def test_demonstrations_that_allow_no_fit_leave_their_figures_out(
    tmp_path: Path, parts: "Parts", presets: "Presets", demonstrations: "Demonstrations"
) -> None:
    write_run(tmp_path / "run", parts, first(demonstrations, 1))
    groups, left_out = group_runs(find_runs([tmp_path])[0], presets)
    content = build(groups, presets, {"shelf": {}}, left_out, tmp_path / "none.json", tmp_path / "report")
    reasons = {part["what"]: part["reason"] for part in content["missing"]}
    assert "must hold at least 2 demonstrations, found 1" in reasons["Figure 2"]
    # Rewards need no demonstrations.
    assert [figure["number"] for figure in content["figures"]] == ["1", "4, right"]
