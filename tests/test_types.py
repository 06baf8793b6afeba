"""A user's script under a type checker, and in an installation without extras."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from ufmstar_torch.runtime.optional import EXTRAS

ROOT = Path(__file__).parent.parent
SCRIPT = """
import numpy as np
import torch
from ufmstar_torch import UfMStar, UncertainDepth
image, pose, K = np.zeros((48, 64, 3), np.uint8), np.eye(4), (50.0, 50.0, 32.0, 24.0)
model = UncertainDepth(torch.nn.Identity(), posterior=True, anchors="dense")
reveal_type(model(image, pose, K))
reveal_type(UfMStar()(torch.ones(1, 48, 64), pose, K).std)
model(image, pose)
UncertainDepth(torch.nn.Identity(), mode="al", anchors="cornes")
"""
# Errors inside the package are `make types`' affair. mypy reads torch and numpy, and takes other packages as Any.
MYPY = f"""
[mypy]
strict = true
follow_imports = silent
[mypy-ufmstar_torch.*]
ignore_errors = true
[mypy-{",".join(f"{name}.*" for name in sorted(EXTRAS))}]
follow_imports = skip
[mypy-torch._dynamo.*,torch._inductor.*,torch._export.*,torch.distributed.*,torch.export.*,torch.fx.*,torch.onnx.*]
follow_imports = skip
"""
# Runs where no package of an extra can be imported.
BARE = """
import sys
from importlib.abc import MetaPathFinder
class Absent(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in EXTRAS:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
import numpy as np, torch
def trajectory():
    from ufmstar_torch.eval.sequences import read_trajectory
def hugging_face():
    from ufmstar_torch.models import from_hugging_face
    from_hugging_face("a/b")
def train_module():
    from ufmstar_torch.train import train_module
def corners():
    from ufmstar_torch.anchors import LandmarkTracker
    LandmarkTracker().update(np.zeros((48, 64, 3), np.uint8), np.eye(4), np.eye(3) + np.eye(3, k=2) * 9)
def command():
    from ufmstar_torch.cli import main
    main(["run", "a", "--depth", "b", "--out", "c"])
def own_network():
    from ufmstar_torch import UncertainDepth
    from ufmstar_torch.models import wrap_network
    model = UncertainDepth(wrap_network(lambda x: x[:, :1] + 1))
    print(model(torch.ones(1, 3, 48, 64), torch.eye(4), (50.0, 50.0, 32.0, 24.0)).std.median())
def choosing():
    from ufmstar_torch.frames.choose import choose
    print("chosen", choose([1.0, 2.0]))
def metrics():
    from ufmstar_torch.eval.metrics import NLL
def ranking():
    from ufmstar_torch.cli import main
    main(["rank", "a", "--depth", "self", "--out", "c"])
for call in (choosing, metrics, ranking, own_network, trajectory, hugging_face, train_module, corners, command):
    try:
        call()
    except ModuleNotFoundError as error:
        print(call.__name__, error)
"""


def test_every_package_of_an_extra_is_known():
    with (ROOT / "pyproject.toml").open("rb") as file:
        extras = tomllib.load(file)["project"]["optional-dependencies"]
    imported = {"opencv-python-headless": "cv2", "pillow": "PIL", "PyYAML": "yaml"}
    for extra in ("models", "eval", "viz", "train", "energy"):
        for line in extras[extra]:
            package = line.partition(">")[0].partition("[")[0]
            name = imported.get(package, package.replace("-", "_"))
            assert name in EXTRAS, line
            assert extra == EXTRAS[name] or package in str(extras[EXTRAS[name]])


def test_what_is_missing_without_extras_is_named():
    script = f"EXTRAS = {set(EXTRAS)}\n{BARE}"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    output = done.stdout + done.stderr
    assert done.returncode == 0, output
    assert "tensor(" in output, output
    for who, package, extra in (
        ("trajectory ufmstar_torch.eval.sequences.read_trajectory", "scipy", "eval"),
        ("hugging_face", "transformers", "models"),
        ("train_module ufmstar_torch.train.train_module", "lightning", "train"),
        ("ufmstar run: failed: this command", r"\w+", "eval"),
        ("ufmstar rank: failed: this command", r"\w+", "eval"),
        ("metrics ufmstar_torch.eval.metrics.NLL", "torchmetrics", "eval"),
    ):
        (line,) = (line for line in output.splitlines() if line.startswith(who))
        assert re.search(rf"needs the package {package}: pip install 'ufmstar-torch\[{extra}\]'", line), line
    assert "chosen [1, 0]" in output, output
    assert "corners landmarks of images need OpenCV: pip install 'ufmstar-torch[eval]'" in output


@pytest.mark.slow
def test_a_type_checker_knows_what_a_call_returns_and_accepts_the_short_examples(tmp_path):
    """Under ``mypy --strict``, with the package as in a wheel."""
    package = tmp_path / "ufmstar_torch"
    package.mkdir()
    for part in [*(ROOT / "ufmstar_torch").iterdir(), *(ROOT / name for name in ("models", "eval", "train"))]:
        (package / part.name).symlink_to(part)
    (tmp_path / "own.py").write_text(SCRIPT)
    names = [f"{name}.py" for name in ("active_learning", "online_training", "train_own_head", "wrap_network")]
    for name in names:
        example = Path(shutil.copy(ROOT / "examples" / name, tmp_path))
        assert len([line for line in example.read_text().splitlines() if line]) < 64, name
    shutil.copy(ROOT / "examples" / "train_decision.py", tmp_path)  # which online_training imports
    (tmp_path / "mypy.ini").write_text(MYPY)
    mypy = [sys.executable, "-m", "mypy", "own.py", *names]
    output = subprocess.run(mypy, cwd=tmp_path, capture_output=True, text=True, check=False).stdout
    assert 'own.py:7: note: Revealed type is "ufmstar_torch.frames.output.UncertaintyOutput"' in output, output
    assert 'own.py:8: note: Revealed type is "torch._tensor.Tensor"' in output, output
    assert "own.py:9: error: Too few arguments" in output, output
    assert 'own.py:10: error: Argument "mode"' in output, output
    assert 'own.py:10: error: Argument "anchors"' in output, output
    assert output.count("error:") == 3, output
