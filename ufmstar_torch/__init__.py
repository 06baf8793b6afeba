"""UfM*: how far to trust a monocular depth network, from the disagreement between its views."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ufmstar_torch.config import SPGFConfig as SPGFConfig
    from ufmstar_torch.config import UfMStarConfig as UfMStarConfig
    from ufmstar_torch.mixture import GaussianMixture as GaussianMixture
    from ufmstar_torch.pipeline import UncertainDepth as UncertainDepth
    from ufmstar_torch.prediction import DepthPrediction as DepthPrediction
    from ufmstar_torch.ufmstar import UfMStar as UfMStar
    from ufmstar_torch.ufmstar import UfMStarOutput as UfMStarOutput

__version__ = "0.1.0"
__all__ = [
    "DepthPrediction",
    "GaussianMixture",
    "SPGFConfig",
    "UfMStar",
    "UfMStarConfig",
    "UfMStarOutput",
    "UncertainDepth",
]
_HOME = {
    "DepthPrediction": "prediction",
    "GaussianMixture": "mixture",
    "SPGFConfig": "config",
    "UfMStar": "ufmstar",
    "UfMStarConfig": "config",
    "UfMStarOutput": "ufmstar",
    "UncertainDepth": "pipeline",
}


def __getattr__(name: str) -> Any:
    """Import a public name's module when it is first asked for (PEP 562): ``ufmstar --help`` needs no torch."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
