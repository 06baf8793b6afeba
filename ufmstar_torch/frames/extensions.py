"""Creates the extensions of a config. No other core module imports all of them."""

from __future__ import annotations

from collections.abc import Sequence

from ufmstar_torch.anchors.confidence import ConfidenceExtension
from ufmstar_torch.anchors.extension import AnchorExtension
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.arguments import require_kind
from ufmstar_torch.frames.extension import Extension, Extensions
from ufmstar_torch.kernels.select import select_anchors
from ufmstar_torch.posterior.extension import PosteriorExtension
from ufmstar_torch.steps.merge import MergeExtension


def extensions_of(config: UfMStarConfig, further: Sequence[Extension] = ()) -> Extensions:
    """The extensions of a config, followed by ``further`` ones.

    Raises:
        ValueError: an extension does not fit the config.
    """
    for extension in require_kind("extensions", further, (list, tuple), "a list of extensions"):
        require_kind("extensions", extension, Extension, "a list of extensions")
    each: list[Extension] = []
    if config.anchors is not None:
        each.append(AnchorExtension(config, select_anchors))
    if config.confidence is not None:
        each.append(ConfidenceExtension(config))
    if config.posterior is not None:
        each.append(PosteriorExtension(config))
    if config.merge is not None:
        each.append(MergeExtension(config))
    return Extensions([*each, *further], config)
