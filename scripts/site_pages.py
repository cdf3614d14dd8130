"""A hook of MkDocs: the pages of the site that do not stand in docs/.

They are the Markdown files beside ``docs/``, of which the README is the home page, and the reference: a page for each
room of the package and one for the modules beside the rooms, which mkdocstrings fills from the docstrings.
"""

import re
from pathlib import Path
from typing import Any, Final

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT: Final = Path(__file__).resolve().parents[1]
PACKAGE: Final = "koopdqn"
HOME: Final = "index.md"

_LINK: Final = re.compile(r"\]\((?:docs/|\.\./)")


def reference() -> dict[str, list[str]]:
    """Return the dotted names of the modules to describe, by page of the reference: the package, then every room."""
    folder = ROOT / PACKAGE
    beside = sorted(path.stem for path in folder.glob("*.py") if not path.name.startswith("_"))
    rooms = sorted(path.parent.name for path in folder.glob("*/__init__.py"))
    pages = {PACKAGE: [PACKAGE, *(f"{PACKAGE}.{name}" for name in beside)]}
    return pages | {f"{PACKAGE}.{room}": [f"{PACKAGE}.{room}"] for room in rooms}


def address(page: str) -> str:
    """Return where a page of the reference stands in the site's sources."""
    return f"reference/{page}.md"


def content(page: str, modules: list[str]) -> str:
    """Return a page of the reference, as Markdown that mkdocstrings fills."""
    # The package's own page names its modules; the rooms in it have pages of their own.
    only = "\n    options:\n      show_submodules: false" if page == PACKAGE else ""
    return "\n\n".join([f"# {page}", *(f"::: {module}{only}" for module in modules)])


def on_config(config: MkDocsConfig) -> None:
    """Add the reference to the navigation."""
    config.nav = [*(config.nav or []), {"Reference": [{page: address(page)} for page in reference()]}]


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the pages that do not stand in docs/."""
    for path in ROOT.glob("*.md"):
        name = HOME if path.name == "README.md" else path.name
        files.append(File.generated(config, name, abs_src_path=str(path)))
    files.append(File.generated(config, "LICENSE", abs_src_path=str(ROOT / "LICENSE")))
    for page, modules in reference().items():
        files.append(File.generated(config, address(page), content=content(page, modules)))


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Return a page with its links to docs/ or out of it as they are in the site, where all lies in one folder."""
    del page
    return _LINK.sub("](", markdown).replace("](README.md", f"]({HOME}")
