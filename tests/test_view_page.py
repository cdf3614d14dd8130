"""The page opens from disk with the network off, animates a motion, and its slider moves the arm."""

import json
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, Browser
from helpers_view import motions, shown

from koopdqn.view.page import Listing, render, write_page

NODE = shutil.which("node")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_page(tmp_path_factory.mktemp("page"), shown().content())


@pytest.fixture(scope="module")
def browser(page: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no Chromium here")
    with Browser(tmp_path_factory.mktemp("profile")) as opened:
        opened.open(page)
        yield opened


def test_the_page_is_small_and_names_nothing_to_fetch(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert len(text.encode()) < 4e6
    assert (
        re.findall(
            r"""(?:src|href)\s*=\s*["'](?!data:)[^"']*["']""",
            re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL),
        )
        == []
    )
    assert not re.search(r"\b(?:fetch|importScripts)\(\s*[\"']http", text)
    assert "Permission is hereby granted" in text


def test_a_title_cannot_end_the_script(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert "a &lt;/script&gt; title" in text
    assert text.count("</script>") == 3


def test_no_text_opens_a_comment_or_a_script_within_the_pages_data() -> None:
    baked = re.findall(
        r'id="baked">(.*?)</script>', render({**shown().content(), "title": "a<!--<script>b"}), re.DOTALL
    )
    assert len(baked) == 1
    assert "<" not in baked[0]
    assert json.loads(baked[0])["title"] == "a<!--<script>b"


def test_the_same_content_gives_the_same_page() -> None:
    assert render(shown().content()) == render(shown().content())


def test_of_very_many_demonstrations_some_lines_from_first_to_last_are_drawn_and_it_says_so() -> None:
    tracks = [np.full((2, 3), float(index)) for index in range(500)]
    content = replace(shown(), tracks=tracks).content()
    drawn = [track[0][0] for track in content["tracks"]]
    assert (drawn[0], drawn[-1], len(drawn)) == (0.0, 499.0, 200)
    assert content["lines"] == ["one line", "lines of 200 of 500 demonstrations are drawn"]
    assert shown().content()["lines"] == ["one line"]


@pytest.mark.skipif(NODE is None, reason="no Node.js here")
def test_the_script_parses(page: Path, tmp_path: Path) -> None:
    script = re.findall(r"<script>(.*?)</script>", page.read_text(encoding="utf-8"), re.DOTALL)[-1]
    (tmp_path / "page.js").write_text(script, encoding="utf-8")
    assert NODE
    assert subprocess.run([NODE, "--check", tmp_path / "page.js"], check=False).returncode == 0


def test_the_page_opens_without_errors_and_fetches_nothing(browser: Browser, page: Path) -> None:
    assert browser.errors == []
    assert browser.requests == [page.resolve().as_uri()]


def test_the_slider_moves_the_arm(browser: Browser) -> None:
    browser.run("view.show(0)")
    browser.settle()
    before = browser.run("view.links()")
    browser.run(
        "(() => { const slider = document.getElementById('slider'); slider.value = slider.max;"
        " slider.dispatchEvent(new Event('input')); })()"
    )
    browser.settle()
    after = browser.run("view.links()")
    last = shown().content()["motions"][0]["links"][-1]
    assert [row for link in after for row in link] == pytest.approx(
        [value for index in range(6) for value in last[7 * index : 7 * index + 3]], abs=1e-6
    )
    assert (
        max(abs(a - b) for one, other in zip(before, after, strict=True) for a, b in zip(one, other, strict=True)) > 0.1
    )
    assert browser.run("document.getElementById('step').textContent") == (
        f"step {len(motions()[0].poses) - 1} of {len(motions()[0].poses) - 1}"
    )


def test_play_animates_and_pause_stops(browser: Browser) -> None:
    browser.run("view.show(0)")
    browser.click("#play")
    until = time.monotonic() + 30.0
    while not browser.run("view.state()")["frame"] and time.monotonic() < until:
        browser.settle()
    browser.click("#play")
    browser.settle()
    state = browser.run("view.state()")
    assert state["frame"] > 0
    assert not state["playing"]
    browser.settle()
    assert browser.run("view.state()") == state


def test_a_start_is_chosen_and_a_preset_moves_the_camera(browser: Browser) -> None:
    options = browser.run("[...document.getElementById('motion').options].map((each) => each.value)")
    assert options[:2] == ["0", "2"]
    browser.run(
        "(() => { const choice = document.getElementById('motion'); choice.value = '2';"
        " choice.dispatchEvent(new Event('change')); })()"
    )
    browser.settle()
    assert browser.run("view.state().motion") == 2
    before = browser.run("camera.position.toArray()")
    browser.click("#views button:nth-child(2)")
    assert browser.run("camera.position.toArray()") != before
    assert browser.errors == []


def test_compared_runs_paths_from_one_start_are_seen_together(tmp_path: Path) -> None:
    if CHROMIUM is None:
        pytest.skip("no Chromium here")
    one, two = (motion for motion in motions() if motion.kind == "learned")
    each = [
        replace(motion, start=start, run=run, colour=colour)
        for start, motion in ((0, one), (1, two))
        for run, colour in (("A", "#0072B2"), ("B", "#009E73"))
    ]
    listing = Listing("<b>Config</b>", ("key", "A"), [("seed", "<i>0</i>")])
    content = replace(shown(), motions=each, listings=[listing]).content()
    with Browser(tmp_path / "profile") as opened:
        opened.open(write_page(tmp_path, content, "compare.html"))
        faint = "paths.map((path) => path.material.opacity < 1)"
        assert opened.run(faint) == [False, False, True, True]
        opened.run("view.show(3)")
        opened.settle()
        assert opened.run(faint) == [True, True, False, False]
        legend = opened.run("document.getElementById('legend').textContent")
        assert legend.endswith("AB")
        assert opened.run("document.querySelector('#listings th[scope=row] + td').textContent") == "<i>0</i>"
        assert opened.errors == []
