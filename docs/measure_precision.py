"""What depth maps in half precision cost: the change of UfM*'s standard deviation beside that from float32 maps.

    python docs/measure_precision.py --root ../shared

prints the table of docs/results/choices.md. The state is float32 in all of them.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
import torch
from clips import Clip, add_sources, clips, estimate, line

from ufmstar_torch import UfMStar

DTYPES = {"float16": torch.float16, "bfloat16": torch.bfloat16}


def changes(clip: Clip, dtype: torch.dtype) -> np.ndarray:
    """Relative change of the standard deviation at the pixels of all frames but the first, where it is above 1 cm."""
    rounded = torch.from_numpy(clip.depth).to(dtype).float().numpy()
    plain, coarse = (np.sqrt(estimate(one, UfMStar())[1:]) for one in (clip, replace(clip, depth=rounded)))
    used = np.isfinite(plain) & np.isfinite(coarse) & (plain > 0.01)
    return np.abs(coarse[used] / plain[used] - 1)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add_sources(parser)
    result = list(clips(parser.parse_args()))
    line("depth maps", "clip", "median", "99th percentile", "largest")
    line(*["---"] * 5)
    for name, dtype in DTYPES.items():
        for clip in result:
            change = changes(clip, dtype)
            line(name, clip.name, *(f"{100 * x:.1f} %" for x in (*np.percentile(change, [50, 99]), change.max())))


if __name__ == "__main__":
    main()
