"""Settings of the posterior."""

from __future__ import annotations

from dataclasses import dataclass

from ufmstar_torch.checked import Checked


@dataclass(frozen=True)
class PosteriorConfig(Checked):
    """The posterior's model (``ufmstar_torch.posterior``)."""
