"""Checks an installed wheel or sdist: every package exists, and none is imported from the checkout."""

from __future__ import annotations

import importlib
import pkgutil
import sys
from pathlib import Path

import ufmstar_torch

home, checkout = Path(ufmstar_torch.__file__).parent, Path(__file__).resolve().parents[1]
assert home != checkout / "ufmstar_torch", f"imported from {home}, expected an installed package"
assert (home / "py.typed").exists(), "py.typed is missing from the archive"
weights = home / "models" / "weights" / "demo.safetensors"
assert weights.exists(), "the demo's networks are missing from the archive"
names = [m.name for m in pkgutil.walk_packages([str(home)], "ufmstar_torch.")]
for name in names:
    importlib.import_module(name)
expected = {"ufmstar_torch.kernels.cpu.segment", "ufmstar_torch.models.fastdepth", "ufmstar_torch.eval.sequences.tum"}
assert expected <= set(names), f"missing from the archive: {sorted(expected - set(names))}"
loaded = {name: Path(str(module.__file__)) for name, module in sys.modules.items() if name.startswith("ufmstar_torch")}
outside = [name for name, file in loaded.items() if not file.is_relative_to(home)]
assert not outside, f"missing from the archive, and imported from elsewhere: {outside}"
print(f"ufmstar_torch {ufmstar_torch.__version__}: {len(names)} modules import from the installed archive")
