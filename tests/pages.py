"""Code on the documentation's pages."""

from __future__ import annotations

import re


def blocks(page: str, language: str = "python") -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page, flags=re.DOTALL)
