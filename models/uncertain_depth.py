"""``UncertainDepth`` for any network, which ``ufmstar_torch`` exports under this name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Literal

import numpy as np
from torch import Tensor, nn

from ufmstar_torch import uncertain_depth as pipeline
from ufmstar_torch.frames import prediction
from ufmstar_torch.frames.prediction import DepthPrediction
from ufmstar_torch.models.any_network import refuse_relative, wrap_network
from ufmstar_torch.models.hugging_face import of_transformers
from ufmstar_torch.models.outputs import METRIC, OutputSpec


class UncertainDepth(pipeline.UncertainDepth):
    __doc__ = pipeline.UncertainDepth.__doc__

    def accepted(
        self, networks: object, preprocess: prediction.Preprocess | Literal["own"] | None
    ) -> tuple[list[nn.Module], prediction.Preprocess | None]:
        """See the base class. Wraps functions, and models and pipelines of ``transformers``, whose ``preprocess`` may
        be a ``Preprocess`` or an image processor."""
        members: list[Any] = [networks]
        if isinstance(networks, Iterable) and not isinstance(networks, nn.Module | str | Mapping | Tensor | np.ndarray):
            members = list(networks)
        for member in members:
            refuse_relative(member)
        foreign = [not isinstance(member, nn.Module) or of_transformers(member) for member in members]
        declared = preprocess if hasattr(preprocess, "to_dict") else None
        modules = [
            wrap_network(member, preprocess=declared) if wrapped else member
            for member, wrapped in zip(members, foreign, strict=True)
        ]
        return super().accepted(modules, "own" if any(foreign) and declared is not None else preprocess)

    def as_prediction(self, result: Any, x: Tensor) -> DepthPrediction:
        """See the base class. A map is assumed to be metric depth."""
        if isinstance(result, DepthPrediction):
            return result
        return OutputSpec(METRIC).prediction(result, x)
