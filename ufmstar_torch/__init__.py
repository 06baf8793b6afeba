"""UfM*: how far to trust a monocular depth network, from the disagreement between its views."""

from typing import TYPE_CHECKING

from ufmstar_torch.runtime.optional import lazy_names

if TYPE_CHECKING:
    from ufmstar_torch.config import AnchorConfig as AnchorConfig
    from ufmstar_torch.config import MergeConfig as MergeConfig
    from ufmstar_torch.config import PosteriorConfig as PosteriorConfig
    from ufmstar_torch.config import SPGFConfig as SPGFConfig
    from ufmstar_torch.config import UfMStarConfig as UfMStarConfig
    from ufmstar_torch.frames.output import UncertaintyOutput as UncertaintyOutput
    from ufmstar_torch.frames.prediction import DepthPrediction as DepthPrediction
    from ufmstar_torch.gaussians.mixture import GaussianMixture as GaussianMixture
    from ufmstar_torch.live import LiveDepth as LiveDepth
    from ufmstar_torch.live import LiveResult as LiveResult
    from ufmstar_torch.posterior.recalibrate import Recalibration as Recalibration
    from ufmstar_torch.ufmstar import UfMStar as UfMStar
    from ufmstar_torch.uncertain_depth import UncertainDepth as UncertainDepth
else:
    # The core takes networks that return a DepthPrediction; the networks' layer adds every other kind.
    __getattr__, __dir__ = lazy_names(__name__, UncertainDepth="ufmstar_torch.models.uncertain_depth")

__version__ = "0.1.0"
__all__ = [
    "AnchorConfig",
    "DepthPrediction",
    "GaussianMixture",
    "LiveDepth",
    "LiveResult",
    "MergeConfig",
    "PosteriorConfig",
    "Recalibration",
    "SPGFConfig",
    "UfMStar",
    "UfMStarConfig",
    "UncertainDepth",
    "UncertaintyOutput",
]
