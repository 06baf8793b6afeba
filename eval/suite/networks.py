"""The networks behind the rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch


@dataclass(frozen=True)
class NetworkChoice:
    """A network for a base, as chosen by the user.

    Attributes:
        base: a key of ``method.BASES``.
        model: a name that ``load_network`` knows, or "ground-truth".
        files: its weights; a .json file among them is its spec.
        label: as shown; "" = told from the files.
    """

    base: str
    model: str
    files: tuple[str, ...] = ()
    label: str = ""

    @classmethod
    def parse(cls, text: str, label: str = "") -> NetworkChoice:
        """From ``BASE=MODEL:FILE[,FILE...]``.

        Raises:
            ValueError: another form.
        """
        base, _, rest = text.partition("=")
        model, _, files = rest.partition(":")
        return cls(base, model, tuple(f for f in files.split(",") if f), label)


class BaseNetwork:
    """The loaded network(s) of a base.

    Args:
        choice: which.
        device: where they run.

    Attributes:
        label: as shown, "FastDepth".
        digest: tells these networks from others.
        identity: plain values for the record of what was run.
    """

    label: str
    digest: str
    identity: dict[str, Any]

    def __init__(self, choice: NetworkChoice, device: torch.device) -> None:
        self.choice = choice
        self.device = device
