"""A method, a metric and a reader of your own, as a plug-in beside UfM*:

    ufmstar eval --plugin examples/own_method.py --suite examples/own_method.toml \
        --network depth_only=fastdepth:fastdepth_nyu.onnx --root tour:5 --out out/own

A method is an ``Estimator``: a prediction and a pose in, a variance per pixel out. A metric is a ``SumMetric``: sums
over the judged pixels. A reader returns a ``FrameSequence``. A package has entry points ``ufmstar.methods``, ...
"""

from functools import partial
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.engine.estimators import Estimator, output_of
from ufmstar_torch.eval.metrics.base import COUNT, SumMetric, share
from ufmstar_torch.eval.sequences.frame import Entry, make_sequence


class ShareOfDepth(Estimator):
    """The standard deviation is a tenth of the depth. The method has no state."""

    def update(self, prediction, T_world_cam, anchors=None):
        depth = prediction.depth
        return output_of(depth, (0.1 * depth).square(), valid=(depth > 0) & depth.isfinite())


class Coverage(SumMetric):
    """The share of pixels whose truth lies within two standard deviations."""

    OF_VARIANCE = "Coverage"
    STATES = (("inside", COUNT), ("pixels", COUNT))

    def sums(self, pixels):
        depth, variance, truth = pixels.judged
        inside = (truth - depth).abs() <= 2 * variance.sqrt()
        return {"inside": pixels.judged.number(inside), "pixels": pixels.judged.number()}

    def compute(self):
        return {"within_2_sigma": share(self.inside, self.pixels)}


class NpzReader:
    """A file walk.npz with images [N, H, W, 3], depths [N, H, W] [m], poses [N, 4, 4] and K [3, 3]."""

    LOOKED_FOR = "a file *.npz with images, depths, poses and K"
    detect = staticmethod(lambda path: path.suffix == ".npz")

    @staticmethod
    def read(path: Path, options):
        data = np.load(path)
        loaders = [[partial(np.asarray, one) for one in data[name]] for name in ("images", "depths")]
        frames = [Entry(f"{i:04d}", T, *load) for i, (T, *load) in enumerate(zip(data["poses"], *loaders, strict=True))]
        size = data["images"].shape[1:3]
        return make_sequence(path.stem, "npz", frames, data["K"], image_size=size, depth_size=size)


METHODS = {"tenth": lambda row, device: ShareOfDepth(uses_variances=row.method.uses_aleatoric)}
METRICS = {"coverage": Coverage}
READERS = {"npz": NpzReader}
