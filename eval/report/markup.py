"""HTML from values: everything that is not markup already is escaped, so no name can become a tag."""

from __future__ import annotations

import re
from collections.abc import Iterable
from html import escape

# Elements without a closing tag.
_VOID = ("br", "hr", "img", "meta", "input")


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()


Child = str | Iterable[str] | None


def tag(name: str, /, *children: Child, **attributes: str | bool | None) -> Markup:
    """An element.

    Args:
        name: of the element.
        children: text (escaped), ``Markup`` (as it is), several of them, or None.
        attributes: by name, a trailing underscore dropped ("class_") and others made hyphens; None and False leave
            one out, True sets it without a value.
    """
    told = []
    for key, value in attributes.items():
        if value is None or value is False:
            continue
        key = key.rstrip("_").replace("_", "-")
        told.append(f" {key}" if value is True else f' {key}="{escape(str(value), quote=True)}"')
    head = f"<{name}{''.join(told)}>"
    return Markup(head if name in _VOID else f"{head}{''.join(map(_markup, children))}</{name}>")


def join(*children: Child, by: str = "") -> Markup:
    """Children one after the other."""
    return Markup(escape(by).join(_markup(child) for child in children))


def typeset(text: str) -> Markup:
    """Text with a minus for a hyphen before a number, and what may not be torn apart held together."""
    found = escape(text)
    found = re.sub(r"(?<![\w.–-])-(?=\d)", "−", found)
    return Markup(found.replace(" ± ", "\u202f±\u202f").replace(" %", "\u202f%"))


class Ids:
    """Hands out identifiers for headings, each once."""

    def __init__(self) -> None:
        self._used: set[str] = set()

    def new(self, text: str) -> str:
        """A unique identifier that reads like the text."""
        plain = re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:60] or "part"
        number, found = 1, plain
        while found in self._used:
            number += 1
            found = f"{plain}-{number}"
        self._used.add(found)
        return found


def _markup(child: Child) -> str:
    if child is None:
        return ""
    if isinstance(child, Markup):
        return str(child)
    if isinstance(child, str):
        return escape(child)
    return "".join(map(_markup, child))
