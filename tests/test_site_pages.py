"""The pages of the site that do not stand in docs/; that all links lead somewhere, the strict build says."""

from pathlib import Path
from typing import cast

import pytest
import site_pages
from mkdocs.structure.pages import Page
from site_roles import ROLE

PACKAGE = Path(site_pages.ROOT, "koopdqn")


def test_the_reference_describes_every_room_and_every_module_beside_them() -> None:
    pages = site_pages.reference()
    assert set(pages) == {"koopdqn"} | {
        f"koopdqn.{path.name}" for path in PACKAGE.iterdir() if (path / "__init__.py").is_file()
    }
    beside = {path.stem for path in PACKAGE.glob("*.py")} - {"__init__", "__main__"}
    assert set(pages["koopdqn"]) == {"koopdqn"} | {f"koopdqn.{name}" for name in beside}


@pytest.mark.parametrize(
    ("written", "shown"),
    [
        ("[the method](docs/algorithm.md#deviations)", "[the method](algorithm.md#deviations)"),
        ("![a picture](docs/images/shelf.png)", "![a picture](images/shelf.png)"),
        ("[rules](../CONTRIBUTING.md)", "[rules](CONTRIBUTING.md)"),
        ("[start](../README.md#start)", "[start](index.md#start)"),
        ("[elsewhere](https://example.org/docs/README.md)", "[elsewhere](https://example.org/docs/README.md)"),
    ],
)
def test_links_lead_to_the_same_place_on_the_site(written: str, shown: str) -> None:
    assert site_pages.on_page_markdown(written, page=cast("Page", None)) == shown


@pytest.mark.parametrize(
    ("written", "shown"),
    [
        ("as :func:`koopdqn.paths.resample` does", "as [`koopdqn.paths.resample`][koopdqn.paths.resample] does"),
        ("the :class:`~Task` of `x`", "the [`Task`][Task] of `x`"),
        ("a ratio 1:2 of ``func``", "a ratio 1:2 of ``func``"),
    ],
)
def test_roles_become_links_and_nothing_else_does(written: str, shown: str) -> None:
    assert ROLE.sub(r"[`\1`][\1]", written) == shown
