"""The results of ``ufmstar live``: a file, a line of figures and a frame of the viewer for every image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from ufmstar_torch.eval.engine.files import write_atomic
from ufmstar_torch.eval.run.export import RunFrame
from ufmstar_torch.live import LiveResult, LiveStatistics

ARRAYS = ("depth", "variance", "disagreement", "T_world_cam", "intrinsics")  # of an image's file


def write_result(out: Path, result: LiveResult) -> None:
    """Write the maps of an image to OUT/STAMP.npz."""
    of = result.out
    maps = {"depth": of.depth, "variance": of.variance, "disagreement": of.disagreement}
    if of.posterior_outlier is not None:
        maps |= {"network_depth": of.network_depth, "ufm_variance": of.ufm_variance}
    arrays = {name: value[0].cpu().numpy() for name, value in maps.items()}
    camera = {"T_world_cam": result.T_world_cam, "intrinsics": result.out.intrinsics[0].cpu().numpy()}
    write_atomic(out / f"{result.stamp:.6f}.npz", lambda file: np.savez(file, allow_pickle=False, **arrays, **camera))


def viewer_frame(result: LiveResult, number: int, figures: dict[str, float]) -> RunFrame:
    """The result in the viewer's form."""
    out, valid = result.out, result.out.valid[0]
    depth, sigma = (torch.where(valid, values[0], torch.nan).cpu().float().numpy() for values in (out.depth, out.std))
    about = (f"{result.stamp:.6f}", number, result.stamp, result.T_world_cam)
    K = out.intrinsics[0].cpu().double().numpy()
    return RunFrame(*about, K, depth, sigma, figures=figures, image=np.asarray(result.image))


def figures_of(result: LiveResult, counts: LiveStatistics) -> dict[str, float]:
    """The figures of an image, and the counts so far."""
    depth, std = result.out.depth, result.out.std
    return {
        "stamp": round(result.stamp, 6),
        "latency_ms": round(1000 * result.latency, 2),
        "depth_m": round(float(depth.nanmedian()), 3),
        "sigma_m": round(float(std.nanmedian()), 3),
        "components": int(result.out.statistics.components[0]),
        "dropped": sum(counts.dropped.values()),
        "skipped": sum(counts.skipped.values()),
    }
