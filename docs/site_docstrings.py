"""An extension of griffe: docstrings as Markdown, in which brackets, stars and signs stay what they are."""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object

_ROLE = re.compile(r":(?:attr|class|data|func|meth|mod):(?=`)")
_CODE = re.compile(r"(```.*?```|``.*?``|`[^`]*`)", re.DOTALL)


class PlainDocstrings(Extension):
    """Escapes the docstrings of all objects."""

    def on_instance(self, *, obj: Object, **_: Any) -> None:
        """Escape the docstring of an object (called by griffe)."""
        if obj.docstring is not None:
            obj.docstring.value = as_markdown(obj.docstring.value)


def as_markdown(text: str) -> str:
    """A docstring as Markdown: units in brackets are no links, stars no emphasis, and roles of Sphinx plain code."""
    parts = _CODE.split(_ROLE.sub("", text))  # code at odd positions
    return "".join(part if i % 2 else re.sub(r"([\[\]*]|<(?=\w))", r"\\\1", part) for i, part in enumerate(parts))
