"""Checks an installed wheel or sdist: every package exists, and none is imported from the checkout."""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path

import ufmstar_torch

home = Path(ufmstar_torch.__file__).parent
assert "site-packages" in str(home), f"imported from {home}, expected an installed package"
assert (home / "py.typed").exists(), "py.typed is missing from the archive"
weights = home / "models" / "weights" / "demo.safetensors"
assert weights.exists(), "the demo's networks are missing from the archive"
names = [m.name for m in pkgutil.walk_packages([str(home)], "ufmstar_torch.")]
for name in names:
    importlib.import_module(name)
expected = {"ufmstar_torch.kernels.cpu.segment", "ufmstar_torch.models.fastdepth", "ufmstar_torch.eval.sequences.tum"}
assert expected <= set(names), f"missing from the archive: {sorted(expected - set(names))}"
print(f"ufmstar_torch {ufmstar_torch.__version__}: {len(names)} modules import from the installed archive")
