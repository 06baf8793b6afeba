"""Trained networks in one safetensors file, with the specification that rebuilds them (``NetworkSpec``) and details of
the training as JSON.

Member n's tensors have the prefix "member.<n>."; a BatchEnsemble, whose members share their tensors, is one network.
"""

from __future__ import annotations

import copy
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ufmstar_torch.frames.arguments import as_path
from ufmstar_torch.models.batch_ensemble import BatchEnsemble
from ufmstar_torch.models.checkpoints import (
    CheckpointError,
    fill,
    read_safetensors,
    require_shapes,
    safetensors_shapes,
    save_checkpoint,
)
from ufmstar_torch.models.dropout import MonteCarloDropout
from ufmstar_torch.models.ensemble import Ensemble, LazyMember
from ufmstar_torch.models.heads import UncertaintyNetwork
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.spec import MOST_MEMBERS, NetworkSpec, build_backbone, build_network
from ufmstar_torch.runtime.kinds import check_kinds

FORMAT = "ufmstar_torch trained networks"
VERSION = 1
_HALF = torch.finfo(torch.float16)
_KEYS = {"format", "version", "spec", "networks", "info"}


@dataclass(frozen=True)
class TrainedInfo:
    """The metadata of a file."""

    path: Path  # of the file
    spec: NetworkSpec  # of every network in it
    networks: int  # their number (a BatchEnsemble is one)
    info: dict[str, Any]  # argument of :func:`save_trained`: the training's command, data, figures

    @property
    def members(self) -> int:
        """Number of networks that :func:`load_trained` returns."""
        return self.networks * self.spec.members


@check_kinds
def save_trained(
    path: str | Path,
    networks: DepthNetwork | Sequence[DepthNetwork],
    spec: NetworkSpec,
    *,
    half: bool = False,
    info: Mapping[str, Any] | None = None,
) -> None:
    """Write trained networks atomically.

    Args:
        path: .safetensors.
        networks: from ``build_network(spec)``, possibly in a ``MonteCarloDropout``; several networks are the members of
            an ensemble.
        spec: specification of the networks.
        half: store weights in half precision. Tensors out of its range (values beyond 65504; variances of a batch norm
            below 6e-5) are stored unchanged.
        info: plain values (JSON) on the origin of the weights.

    Raises:
        ValueError: no network, a network that does not fit ``spec``, another suffix, or weights that are not finite.
        TypeError: ``info`` holds values that JSON does not support.
    """
    path = Path(path)
    members = [networks] if isinstance(networks, DepthNetwork) else list(networks)
    if path.suffix != ".safetensors" or not members:
        raise ValueError(f"need a file .safetensors and at least one network, got {path.name} and {len(members)}")
    # The reference of custom networks is the first member.
    own_module = spec.module is not None and spec.module.checkpoint is None
    reference = _unwrapped(members[0]) if own_module else _new(spec)
    expected = {key: value.shape for key, value in reference.state_dict().items()}
    state: dict[str, Tensor] = {}
    for n, member in enumerate(members):
        weights = _unwrapped(member).state_dict()
        if {key: value.shape for key, value in weights.items()} != expected:
            raise ValueError(f"network {n} ({type(member).__name__}) does not match its spec: {spec}")
        state |= {f"member.{n}.{key}": value for key, value in weights.items()}
    if broken := [key for key, value in state.items() if not torch.isfinite(value).all()]:
        raise ValueError(f"{broken[0]} has NaN or infinity ({len(broken)} such tensors): training diverged")
    if half:
        state = {key: value.half() if _fits_half(key, value) else value for key, value in state.items()}
    metadata = {"format": FORMAT, "version": VERSION, "spec": spec.to_dict(), "networks": len(members)}
    save_checkpoint(path, state, {**metadata, "info": dict(info or {})})


@check_kinds
def read_info(path: str | Path) -> TrainedInfo:
    """Read the metadata of a file without its weights. Raises FileNotFoundError: there is no such file;
    CheckpointError: it is damaged, of another format or of a newer version; ModuleNotFoundError: safetensors is not
    installed."""
    return _TrainedFile(Path(path)).info


@check_kinds
def load_trained(
    path: str | Path | Iterable[str | Path],
    *,
    backbone: nn.Module | None = None,
    lazy: bool = False,
    offload: bool = False,
) -> list[DepthNetwork]:
    """Load the networks of one or several files, in eval mode and on the CPU, for ``UncertainDepth``.

    "mc_dropout" becomes a :class:`MonteCarloDropout`, "batch_ensemble" its members, which share their weights. Weights
    are converted to float32.

    Args:
        path: a file, or several, whose networks are concatenated.
        backbone: the custom network below the heads, as passed to ``train_module``; copied, and filled from the file.
        lazy: read a network's weights at its first call; their metadata are read immediately.
        offload: see :class:`LazyMember`.

    Raises:
        FileNotFoundError, CheckpointError, ModuleNotFoundError: as :func:`read_info`; and if weights are missing,
            unexpected, of another shape or not finite, with ``lazy`` at the first call.
    """
    files = list(path) if isinstance(path, Iterable) and not isinstance(path, str | bytes) else [path]
    paths = [as_path("path", file) for file in files]
    members: list[DepthNetwork] = []
    for file in [_TrainedFile(Path(p), backbone) for p in paths]:
        if not lazy and not offload:
            members += [file.member(n) for n in range(file.info.members)]
            continue
        for n in range(file.info.members):
            name = f"{file.path}, member {n}"
            later = LazyMember(partial(file.member, n), file.info.spec.input(), name=name, offload=offload)
            if not lazy:
                later.network()
            members.append(later)
    return members


def load_ensemble(weights: Path, backbone: nn.Module | None = None) -> DepthNetwork:
    """Load all networks of a file as one network, an :class:`Ensemble` if there are several; arguments and errors as
    :func:`load_trained`."""
    members = load_trained(weights, backbone=backbone)
    return members[0] if len(members) == 1 else Ensemble(members)


def load_for_training(path: str | Path, backbone: nn.Module | None = None) -> list[UncertaintyNetwork | BatchEnsemble]:
    """Load the networks of a file in the form of ``build_network``, in training mode; arguments and errors as
    :func:`load_trained`."""
    file = _TrainedFile(Path(path), backbone)
    return [file.read(index).train() for index in range(file.info.networks)]


class _TrainedFile:
    """A file whose networks are read individually, shared weights once. Raises FileNotFoundError, CheckpointError,
    ModuleNotFoundError: as :func:`read_info`."""

    def __init__(self, path: Path, backbone: nn.Module | None = None) -> None:
        self.path, self.backbone = path, backbone
        self.info = _parse(path, read_safetensors(path, prefix=None)[1])
        self._shared: dict[int, Any] = {}  # networks of BatchEnsembles, shared by their members
        self._lock = threading.Lock()

    def member(self, n: int) -> DepthNetwork:
        """Network n of :func:`load_trained`, in eval mode. Raises CheckpointError: its weights are damaged or do not
        fit; the message names the file and the member."""
        index, member = divmod(n, self.info.spec.members)
        if self.info.spec.method != "batch_ensemble":
            network = self.read(index)
            return MonteCarloDropout(network).eval() if self.info.spec.method == "mc_dropout" else network
        with self._lock:
            if index not in self._shared:
                self._shared[index] = self.read(index)
            return self._shared[index].member(member)

    def __reduce__(self) -> tuple[type[_TrainedFile], tuple[Any, ...]]:
        return _TrainedFile, (self.path, self.backbone)  # a copy reads the file again

    def read(self, index: int) -> UncertaintyNetwork | BatchEnsemble:
        """The network stored under an index, in eval mode. Raises CheckpointError: as :meth:`member`."""
        prefix, source = f"member.{index}.", f"{self.path}, member {index},"
        # Compare shapes without memory first: the file's spec may state any size.
        with torch.device("meta"):
            shapes = safetensors_shapes(self.path, prefix)
            require_shapes(_new(self.info.spec, self.backbone), shapes, source)
        network = _new(self.info.spec, self.backbone)
        fill(network, read_safetensors(self.path, prefix)[0], source)
        return network.eval()


def _parse(path: Path, metadata: Any) -> TrainedInfo:
    """Check and convert the metadata of a file."""
    if not isinstance(metadata, dict) or metadata.get("format") != FORMAT:
        raise CheckpointError(f"{path} holds no trained networks of this package (it does not name the format)")
    version = metadata.get("version")
    if version != VERSION:
        newer = isinstance(version, int) and version > VERSION
        advice = "written by a newer release of this package: update it" if newer else "which does not exist"
        raise CheckpointError(f"{path} is of version {version!r}, {advice} (this one reads {VERSION})")
    count, info = metadata.get("networks"), metadata.get("info")
    if set(metadata) != _KEYS or type(count) is not int or not 1 <= count <= MOST_MEMBERS or not isinstance(info, dict):
        raise CheckpointError(f"{path} has damaged metadata: {sorted(metadata)}, networks {count!r}")
    try:
        spec = NetworkSpec.from_dict(metadata["spec"])
    except (TypeError, ValueError) as error:
        raise CheckpointError(f"{path} has a spec that cannot be built: {error}") from error
    return TrainedInfo(path, spec, count, info)


def _new(spec: NetworkSpec, backbone: nn.Module | None = None) -> UncertaintyNetwork | BatchEnsemble:
    """A network with random weights that leaves the caller's random state unchanged."""
    with torch.random.fork_rng(devices=[]):
        return build_network(spec, build_backbone(spec, copy.deepcopy(backbone)))


def _unwrapped(network: DepthNetwork) -> nn.Module:
    return network.network if isinstance(network, MonteCarloDropout) else network


def _fits_half(key: str, value: Tensor) -> bool:
    """True if a tensor can be stored in half precision: small weights may become 0, but variances may not."""
    if value.dtype not in (torch.float32, torch.float64) or not value.numel():
        return False
    tiny = key.endswith("running_var") and value.min() < _HALF.tiny
    return not tiny and bool(value.abs().max() <= _HALF.max)
