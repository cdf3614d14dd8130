"""An extension of griffe, which reads docstrings for the site: roles such as ``:func:`name``` become links."""

import re
from typing import Any, Final

import griffe

ROLE: Final = re.compile(r":(?:attr|class|data|exc|func|meth|mod):`~?([\w.]+)`")


class Roles(griffe.Extension):
    """Writes every role in a docstring as a cross-reference of Markdown, which is resolved where it stands."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Change the docstring of an object that was read."""
        if obj.docstring:
            obj.docstring.value = ROLE.sub(r"[`\1`][\1]", obj.docstring.value)
