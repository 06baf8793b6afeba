"""The sentences that ``ufmstar run`` prints below its table."""

from __future__ import annotations

import re
import shutil

import layouts
import pytest

QUICK = ("--depth", "self", "--plain", "--no-video", "--no-sheet")
ASSUMED = {
    "relative": "their sigma is assumed, 20% of the depth",
    "paper": "their sigma is assumed to be 0, as in the paper",
    "nan": "their sigma is not known",
}


@pytest.mark.parametrize("unmeasured", ASSUMED)
def test_pixels_that_were_seen_once(ufmstar, tmp_path, unmeasured):
    out = tmp_path / "out"
    words = ("run", "tour:1?frames=3&size=48x64", *QUICK, "--set", f"unmeasured={unmeasured}", "--out", str(out))
    code, printed, _ = ufmstar(*words)
    assert code == 0
    assert re.search(rf"^\d+% of the pixels were seen once; {ASSUMED[unmeasured]}$", printed, re.MULTILINE)
    assert re.search(r"^\d+ components in \d", printed, re.MULTILINE)


def test_a_sigma_that_nothing_verifies_is_not_shown(ufmstar, tmp_path):
    path, _ = layouts.write_generic(tmp_path / "one", frames=3)
    shutil.copytree(path / "depth", tmp_path / "maps")
    shutil.rmtree(path / "depth")
    words = ("run", str(path), "--depth", str(tmp_path / "maps"), *QUICK[2:], "--out", str(tmp_path / "out"))
    code, out, _ = ufmstar(*words, "--depth-scale", "0.001")
    assert code == 0
    assert "; mean sigma not shown: nothing here can verify it; leave --plain out\n" in out
