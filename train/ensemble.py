"""The members of an ensemble on disk: which are finished, and what came out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ufmstar_torch.models.checkpoints import fill, read_safetensors
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.spec import build_network
from ufmstar_torch.models.trained import read_info
from ufmstar_torch.train.member import RESULT, Job


def read_result(job: Job, member: int) -> dict[str, Any]:
    """A member's result.json; empty where there is none."""
    file = job.folder(member) / RESULT
    return dict(json.loads(file.read_text(encoding="utf-8"))) if file.is_file() else {}


def finished(job: Job, member: int) -> bool:
    """Whether a member needs no more training."""
    return bool(read_result(job, member).get("finished"))


def stored_networks(path: Path) -> DepthNetwork:
    """The one network in a member's file, in the form that it is trained in."""
    network = build_network(read_info(path).spec)
    state, _ = read_safetensors(path, prefix="member.0.")
    fill(network, {name: value.float() if value.is_floating_point() else value for name, value in state.items()}, str(path))
    return network
