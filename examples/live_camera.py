"""Show the standard deviation of the live camera's corrected depth. A SLAM writes the poses to a trajectory file.

    python examples/live_camera.py --weights fastdepth_nyu.onnx --trajectory poses.txt --intrinsics 600 600 319.5 239.5

Lines of the trajectory are ``time x y z qx qy qz qw``: the system's clock [s], camera-to-world [m]. q ends.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from ufmstar_torch import LiveDepth, LiveResult, UfMStarConfig, UncertainDepth
from ufmstar_torch.eval.sequences.live import PoseFile, camera
from ufmstar_torch.models import load_network


def main(words: Sequence[str] | None = None) -> Any:
    """Show the camera until q is pressed; the counts of images, drops and skips."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--weights", required=True, help="FastDepth's: .onnx")
    parser.add_argument("--trajectory", required=True, help="lines are added by a SLAM")
    parser.add_argument("--intrinsics", required=True, nargs=4, type=float, metavar=("FX", "FY", "CX", "CY"))
    parser.add_argument("--camera", type=int, default=0)
    options = parser.parse_args(words)
    network = load_network("fastdepth", options.weights)
    model = UncertainDepth(network, UfMStarConfig(on_bad_frame="skip"))
    model.warm_up()
    latest: list[LiveResult] = []  # only the newest result; OpenCV windows need the main thread

    def on_result(result: LiveResult) -> None:
        latest[:] = [result]

    with LiveDepth(model, on_result, options.intrinsics) as live:
        for event in camera(options.camera, PoseFile(options.trajectory)):
            if event.T_world_cam is not None:
                live.push_pose(event.stamp, event.T_world_cam)
            elif event.image is not None:
                live.push_image(event.stamp, event.image)
            if latest:
                sigma = latest.pop().out.std[0].numpy()
                cv2.imshow("sigma, 0 to 1 m", np.uint8(255 * np.clip(np.nan_to_num(sigma), 0, 1)))
            if cv2.waitKey(1) == ord("q"):
                break
    print(live.statistics)
    return live.statistics


if __name__ == "__main__":
    main()
