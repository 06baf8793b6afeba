"""UfM*: how far to trust a monocular depth network, from the disagreement between its views."""

__version__ = "0.1.0"
