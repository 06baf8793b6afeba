"""A network that can be held back, and what tests of ``LiveDepth`` do with its model."""

from __future__ import annotations

import threading

import numpy as np
import pytest
import torch

from ufmstar_torch import DepthPrediction, UncertainDepth

K = (50.0, 50.0, 31.5, 23.5)
PICTURE = np.zeros((48, 64, 3), np.uint8)
HANGS = 250  # [s] longer than any wait on a loaded machine


class Network(torch.nn.Module):
    """Predicts 2 m everywhere. A call sets ``entered`` and waits for ``gate``."""

    def __init__(self):
        super().__init__()
        self.gate, self.entered = threading.Event(), threading.Event()
        self.gate.set()

    def forward(self, x):
        self.entered.set()
        assert self.gate.wait(HANGS)
        if x.float().mean() > 0.8:
            raise OSError("the network failed")
        return DepthPrediction(torch.full((len(x), 48, 64), 2.0))


@pytest.fixture(scope="module", autouse=True)
def compiled():
    """Compile all kernels before the first image of a test."""
    UncertainDepth(Network())(PICTURE, np.eye(4), K)


@pytest.fixture
def network():
    return Network()


@pytest.fixture
def model(network):
    return UncertainDepth(network)


def at(x):
    T = np.eye(4)
    T[0, 3] = x
    return T


def show(live, stamp, picture=PICTURE, x=0.0):
    """Push a pose and an image with its stamp, and wait until both are processed."""
    live.push_pose(stamp, at(x))
    live.push_image(stamp, picture)
    assert live.wait_idle(HANGS)


def stamps(results):
    return [result.stamp for result in results]


def require_all_counted(live):
    counts = live.statistics
    assert counts.images == counts.results + sum(counts.dropped.values()) + sum(counts.skipped.values())
    return counts
