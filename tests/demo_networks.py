"""Untrained networks for the tests of the demo."""

from __future__ import annotations

import torch

from ufmstar_torch.models import NetworkSpec, build_network, save_trained

SIZE = (64, 96)
SPEC = NetworkSpec(widths=0.1, positive="softplus", size=SIZE, preprocess="resize")


def members(count=3, spec=SPEC):
    """Untrained networks with different depths."""
    torch.manual_seed(0)
    networks = [build_network(spec).eval() for _ in range(count)]
    with torch.no_grad():
        for n, network in enumerate(networks):
            network.backbone.head.norm.weight *= 30  # depth that follows the image
            network.backbone.head.norm.bias += 0.1 * n
    return networks


def write_members(path, count=3):
    """Write some of these networks to a file, and return its path."""
    save_trained(path, members(count), SPEC, info={"note": "a test"})
    return path
