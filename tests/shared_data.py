"""Paths of the shared material: real sequences, weights, reference partitions."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2] / "shared"


def require_shared(relative: str) -> Path:
    """The path of shared material. If it is missing, skip the test, or fail in CI."""
    path = ROOT / relative
    if not path.exists():
        reason = f"needs the shared material {relative}, which lies beside the project in its own checkout only"
        if os.environ.get("UFMSTAR_REQUIRE_SHARED"):
            pytest.fail(f"UFMSTAR_REQUIRE_SHARED is set, {reason}")
        pytest.skip(reason)
    return path
