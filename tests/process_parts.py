"""A plug-in for spawned processes: a sequence reader that kills the process, fails or waits.

``NAME.act`` contains "kill", "fail", "wait", "go", or "hold": it goes once a file "release" is beside it.
"""

from __future__ import annotations

import os
import signal
import time

import numpy as np

from ufmstar_torch.eval.sequences.frame import Entry, make_sequence


def acting(folder, truth, *acts):
    """The words of an evaluation of sequences a, b, ... with these actions; ``truth`` is the option of its network."""
    folder.mkdir()
    roots = [folder / f"{name}.act" for name in "abcd"[: len(acts)]]
    for root, act in zip(roots, acts, strict=True):
        root.write_text(act)
    (folder / "alone.toml").write_text('[[rows]]\nmethods = ["DepthOnly"]\n')
    words = ["--suite", folder / "alone.toml", "--plugin", __file__, "--network", truth]
    words += ["--root", *(f"d={root}" for root in roots), "--threads", 1, "--no-report", "--out", folder / "out"]
    return [str(word) for word in words]


class Acting:
    LOOKED_FOR = "a file *.act"
    detect = staticmethod(lambda path: path.suffix == ".act")

    @staticmethod
    def read(path, options):
        act = path.read_text()
        path.with_suffix(f".{os.getpid()}").touch()
        while act == "hold" and not path.with_name("release").exists():
            time.sleep(0.02)
        while act not in ("go", "hold") and len(list(path.parent.glob("*.[0-9]*"))) < 2:
            time.sleep(0.02)  # until another process has started, too
        if act == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if act == "fail":
            raise TypeError("a mistake")

        def load(value):
            time.sleep(0.05 if act == "wait" else 0)
            return value

        image, depth = np.zeros((24, 32, 3), np.uint8), np.ones((24, 32), np.float32)
        loaders = [lambda: load(image), lambda: load(depth)]
        frames = [Entry(f"{i:05d}", np.eye(4), *loaders) for i in range(9999 if act == "wait" else 2)]
        K = np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]])
        return make_sequence(path.stem, "act", frames, K, image_size=(24, 32), depth_size=(24, 32))


READERS = {"act": Acting}
