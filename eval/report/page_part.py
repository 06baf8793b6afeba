"""A part of the page, and the figures and lists that parts are made of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.report.embed import Embedder, image
from ufmstar_torch.eval.report.markup import Markup, tag, typeset


@dataclass(frozen=True)
class Part:
    """A part with a heading of its own in the table of contents.

    Attributes:
        title: the heading.
        body: below it.
    """

    title: str
    body: Sequence[Markup]


def paragraph(text: str) -> Markup:
    """Plain words."""
    return tag("p", typeset(text))


def bullets(texts: Sequence[str], class_: str) -> Markup:
    """Sentences below each other."""
    return tag("ul", [tag("li", typeset(text)) for text in texts], class_=class_)


def figure(embedder: Embedder, path: Path, alt: str, title: str = "", caption: str = "") -> Markup | None:
    """A picture with its words; None where there is no room for it.

    Raises:
        ValueError, OSError: see ``Embedder.take``.
    """
    found = embedder.take(path)
    if found is None:
        return None
    words = tag("figcaption", tag("b", f"{title}. ") if title else None, caption) if title or caption else None
    shown = tag("div", image(found, alt), class_="scroll", role="region", aria_label=title or alt, tabindex="0")
    return tag("figure", shown, words)


def folded(title: str, *body: Markup, open_: bool = False) -> Markup:
    """Something that only some readers want to see."""
    return tag("details", tag("summary", title), body, open=open_)


def values(found: Mapping[str, Any]) -> Markup:
    """Settings, versions and the like, by name; what is None or empty is left out."""
    terms = [
        (tag("dt", str(name).replace("_", " ")), tag("dd", _value(value)))
        for name, value in found.items()
        if value not in (None, "", [], {}, ())
    ]
    return tag("dl", *[term for pair in terms for term in pair])


def _value(value: Any) -> Markup | str:
    if isinstance(value, Mapping):
        return values(value)
    if isinstance(value, list | tuple):
        if any(isinstance(item, Mapping | list | tuple) for item in value):
            return tag("ul", [tag("li", _value(item)) for item in value])
        return ", ".join("–" if item is None else _plain(item) for item in value)
    text = _plain(value)
    # A digest is for comparing, not for reading.
    return tag("code", text) if len(text) >= 32 and " " not in text else text


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.12g}" if isinstance(value, float) else str(value)
