"""An evaluation: a suite, its networks, the sequences and the output folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from ufmstar_torch.eval.engine.load import NetworkChoice
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.methods.method import FUSIONS
from ufmstar_torch.eval.methods.suite import Suite
from ufmstar_torch.eval.run.machine import hardware, versions
from ufmstar_torch.eval.sequences.plugins import load_plugins
from ufmstar_torch.eval.suite.folder import EvalFolder
from ufmstar_torch.eval.suite.work_items import WorkItem
from ufmstar_torch.models.inference import Inference


@dataclass(frozen=True)
class EvalJob:
    """An evaluation."""

    suite: Suite  # with the rows whose base has a network
    networks: Mapping[str, NetworkChoice]  # by base
    items: tuple[WorkItem, ...]  # the sequences
    out: Path  # output folder
    missing_bases: tuple[str, ...] = ()  # bases of omitted rows, which have no network
    frames: slice = field(default_factory=lambda: slice(None))  # selects frames of each sequence
    cache: Path | None = None  # folder of predictions; None = in ``out``
    device: str = "cpu"  # "cpu", "cuda", "cuda:1"
    bins: str = "ours"  # of the calibration errors: "ours" or "authors", see ``SequenceMetrics``
    examples: int = 3  # number of sequences of each data set with stored frames for pictures
    plugin: tuple[str, ...] = ()  # files with the user's methods and metrics
    samples: int | None = None  # passes of MC-Dropout
    # runtime, precision: of the networks (``Inference``).
    runtime: str = "auto"
    precision: str = "float32"

    @property
    def folder(self) -> EvalFolder:
        """The records in the output folder."""
        return EvalFolder(self.out)

    @property
    def unused(self) -> tuple[str, ...]:
        """Bases with a network that no row of the suite has."""
        return tuple(base for base in self.networks if base not in self.suite.bases)

    def load(self, device: torch.device) -> dict[str, DepthSource]:
        """Load the networks that the rows need. Raises FileNotFoundError, ValueError, ImportError, see
        ``NetworkChoice.load``."""
        needed = [self.networks[base] for base in self.suite.bases if base in self.networks]
        inference = Inference(self.runtime, self.precision)
        return {choice.base: choice.load(device, samples=self.samples, inference=inference) for choice in needed}

    def about(self, networks: Mapping[str, DepthSource]) -> dict[str, Any]:
        """The content of eval.json."""
        suite, f = self.suite, self.frames
        bins = {} if self.bins == "ours" else {"bins": self.bins}
        opening = {n: v for item in self.items for n, v in item.opening.changed().items() if n != "layout"}
        return {
            "suite": suite.name,
            "title": suite.title,
            **({"separate": True} if suite.separate else {}),
            "networks": {base: network.identity for base, network in networks.items()},
            "rows": [row.to_dict() for row in suite.rows],
            "datasets": list(dict.fromkeys(item.dataset for item in self.items)),
            "sequences": [{"dataset": item.dataset, "sequence": item.sequence} for item in self.items],
            "missing_bases": list(self.missing_bases),
            "settings": {"frames": [f.start, f.stop, f.step], **bins, **opening},
            "versions": versions(),
            "machine": hardware(),
        }

    def stores_examples(self, item: WorkItem) -> bool:
        """True if the sequence is one of the first ``examples`` of its data set."""
        same = [other for other in self.items if other.dataset == item.dataset]
        return item in same[: self.examples]


def require_methods(suite: Suite, plugin: Sequence[str]) -> None:
    """Raises ValueError: a row's method is neither in this package nor in a plug-in, or is a plug-in's in a suite that
    measures cost."""
    methods = load_plugins(plugin).methods
    for row in suite.rows:
        fusion = row.method.fusion
        if fusion not in FUSIONS and (fusion not in methods or suite.efficiency):
            remedy = f"there are {', '.join(methods)}" if methods else "--plugin FILE.py adds yours"
            why = "the cost of a method of one's own is not measured" if fusion in methods else remedy
            raise ValueError(f"suite {suite.name}: row {row.method.name}: {why}")
