"""Depth sources from files: a user's choice for a base of a suite, and the networks of ``ufmstar run``."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from ufmstar_torch.eval.engine.maps import TRUTH, MapSource, own_depth
from ufmstar_torch.eval.engine.network_checks import check_members, without_sampling
from ufmstar_torch.eval.engine.networks import NetworkSource, stochastic
from ufmstar_torch.eval.methods.method import BASES
from ufmstar_torch.eval.sequences.frame import Size, parse_size
from ufmstar_torch.models.dropout import SAMPLES
from ufmstar_torch.models.inference import Inference, runtime_of
from ufmstar_torch.models.load import DIRECTORIES, load_network, network_names
from ufmstar_torch.models.monodepth2 import MonodepthResNet
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.trained import load_trained, read_info
from ufmstar_torch.networks_in_turn import NetworksInTurn

_FORM = "BASE=MODEL:FILE[,FILE...]"
_CPU, _AS_USERS = torch.device("cpu"), Inference()
_VERSION = 4  # of the digests: raise it where predictions from the same files change


@dataclass(frozen=True)
class NetworkChoice:
    """A network for a base, as chosen by a user.

    Raises:
        ValueError: no such base or model, no files, or files that do not go together.
    """

    base: str  # a key of ``method.BASES``
    model: str  # a name that ``load_network`` accepts, or "ground-truth": of "depth_only", the sequence's own depth
    # Weights, in the order of the members: "FILE#2" is member 2 of a file of "trained" alone, a file .json the spec of
    # the weights; for "ground-truth" nothing, or "HxW".
    files: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.base not in BASES:
            raise ValueError(f"base must be one of {', '.join(BASES)}, got {self.base!r}; expected {_FORM}")
        if self.model == TRUTH:
            if self.base != "depth_only" or len(self.files) > 1:
                raise ValueError("ground-truth goes with depth_only, as in depth_only=ground-truth[:HxW]")
            try:
                parse_size(self.files[0] if self.files else None)
            except ValueError as error:
                raise ValueError(f"ground-truth:HxW needs a size in pixels, got {self.files[0]!r}") from error
            return
        if self.model not in network_names():
            names = ", ".join((*network_names(), TRUTH))
            raise ValueError(f"model must be one of {names}, got {self.model!r}; expected {_FORM}")
        if not self.weights:
            raise ValueError(f"{self.base}={self.model} needs the file of its weights: {_FORM}")
        if len(self.files) - len(self.weights) > 1:
            raise ValueError(f"{self.base}={self.model} takes one spec, got {self.files}")

    @classmethod
    def parse(cls, text: str) -> NetworkChoice:
        """Parse ``BASE=MODEL:FILE[,FILE...]``. Raises ValueError: another form."""
        base, equals, rest = text.partition("=")
        model, _, files = rest.partition(":")
        if not (base and equals and model):
            raise ValueError(f"a network must be given as {_FORM}, got {text!r}")
        return cls(base, model, tuple(file for file in files.split(",") if file))

    def with_spec(self, spec: str | None) -> NetworkChoice:
        """The choice with that spec, unless it has one, or needs none as the sequence's own depth."""
        if spec is None or self.spec is not None or self.model == TRUTH:
            return self
        if not spec.endswith(".json"):
            raise ValueError(f"--spec must be a file *.json, got {spec!r}")
        return replace(self, files=(*self.files, spec))

    @property
    def weights(self) -> tuple[str, ...]:
        """The files without the spec."""
        return tuple(file for file in self.files if not file.endswith(".json"))

    @property
    def spec(self) -> str | None:
        """The file that declares what the weights do not say."""
        return next((file for file in self.files if file.endswith(".json")), None)

    @property
    def size(self) -> Size | None:
        """(h, w) to which ground truth is brought; None = as it is."""
        return parse_size(self.files[0]) if self.model == TRUTH and self.files else None

    def load(
        self, device: torch.device, *, samples: int = SAMPLES, inference: Inference = _AS_USERS
    ) -> NetworkSource | MapSource:
        """The depth source on a device: an ensemble's or BatchEnsemble's members in turn; of MC-Dropout one sample an
        image, or ``samples`` of them. Errors as :func:`load_members` and ``check_members``."""
        if self.model == TRUTH:
            return own_depth(self.size)
        try:
            members = load_members(self.model, self.weights, spec=self.spec, inference=inference, device=device)
        except ValueError as error:
            raise ValueError(f"{self.base}={self.model}: {error}") from error
        sampling = self.base == "mc_dropout"
        members = members if sampling else [without_sampling(member) for member in members]
        check_members(self.base, members, device)
        passes = samples if sampling else None
        return _source(self.model, self.weights, self.spec, members, passes, inference, device, stored=True)


def network_source(
    model: str,
    weights: Iterable[str | Path],
    *,
    mode: str = "alternate",
    samples: int | None = None,
    spec: str | Path | None = None,
    offload: bool = False,
    inference: Inference = _AS_USERS,
    device: str = "cpu",
) -> NetworkSource:
    """One network, or the members of an ensemble, from files (:func:`load_members`), as ``ufmstar run`` runs them. Mode
    is "alternate" (one member per image in turn) or "full" (all of them on every image, or ``samples`` passes of a
    network that samples; None: as many as the paper's baseline). Raises FileNotFoundError, ValueError, also for mode
    "full" of one network that does not sample, and ``samples`` for any other."""
    files, where = tuple(str(file) for file in weights), torch.device(device)
    members = load_members(model, files, spec=spec, offload=offload, inference=inference, device=where)
    alone = len(members) == 1 and mode == "full"
    if alone and not stochastic(members):
        raise ValueError("mode 'full' needs several members, or one with dropout that samples; there is one without")
    if samples is not None and not alone:
        raise ValueError(f"samples goes with mode 'full' and one network that samples, there are {len(members)}")
    passes = (samples or SAMPLES) if alone else None
    return _source(model, files, spec, members, passes, inference, where, mode=mode)


def _source(
    model: str,
    files: Iterable[str],
    spec: str | Path | None,
    members: Sequence[DepthNetwork],
    samples: int | None,
    inference: Inference,
    device: torch.device,
    *,
    stored: bool = False,
    **more: Any,
) -> NetworkSource:
    """The source of loaded members; its predictions may be ``stored``. ``more`` are values of its identity."""
    named = [(Path(path), member) for path, member in map(_path, files)]
    identity = {
        "model": model,
        "label": _label(model, named[0][0], members[0]),
        "files": [{"name": path.name, "sha256": sha256(path), "member": member} for path, member in named],
        "spec": None if spec is None else sha256(Path(spec)),
        "members": len(members),
        "samples": samples,
        # Settings that change the last bits of a prediction.
        "runtime": runtime_of(members[0], inference.precision)["name"],
        "precision": inference.precision,
        **more,
    }
    nameless = {"label": None, "files": [file | {"name": None} for file in identity["files"]]}
    content = json.dumps({**identity, **nameless, "device": device.type, "version": _VERSION}, sort_keys=True)
    digest = hashlib.sha256(content.encode()).hexdigest() if stored else ""
    turns = NetworksInTurn(members, samples=samples, preprocess=members[0].preprocess)
    how: dict[str, Any] = {"precision": inference.precision, "label": identity["label"], "digest": digest}
    return NetworkSource(turns, device, identity, **how)


def load_members(
    model: str,
    files: Iterable[str],
    *,
    spec: str | Path | None = None,
    offload: bool = False,
    inference: Inference = _AS_USERS,
    device: torch.device = _CPU,
) -> list[DepthNetwork]:
    """The networks in files, in their order, in eval mode and on the CPU.

    Args:
        model: a name that ``load_network`` accepts.
        files: one for each member (a directory for networks of ``transformers``). Those of "trained" may hold several,
            of which FILE#2 is number 2, counted from 0.
        spec: declares what an ONNX file or saved program does not say.
        offload: of "trained": weights stay in host memory and come to the device for their turn only.
        inference, device: how and where they will run.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: unknown model, files that do not fit it, members that want different inputs.
    """
    named = [(Path(path), member) for path, member in map(_path, files)]
    for path, _ in named if model in DIRECTORIES else ():
        if not path.is_dir():
            fetch = "`hf download NAME --local-dir DIR` fetches a checkpoint from the hub"
            raise FileNotFoundError(f"no such directory: {path}; {fetch}")
    for path in (*(path for path, _ in named if model not in DIRECTORIES), *([Path(spec)] if spec else [])):
        if not path.is_file() and not (model == "monodepth2" and path.is_dir()):
            raise FileNotFoundError(f"no such file: {path}")
    members: list[DepthNetwork] = []
    how = {} if spec is None else {"spec": spec}
    for path, member in named:
        if model == "trained" and not how:
            loaded = load_trained([path], offload=offload)
        else:
            try:
                loaded = [load_network(model, path, **how, **inference.options(model, device))]
            except TypeError as error:
                raise ValueError(f"model {model!r} does not take {sorted(how)}: {error}") from error
        if member is not None and member >= len(loaded):
            raise ValueError(f"{path} has {len(loaded)} members, there is no {member} (counted from 0)")
        selected = loaded if member is None else [loaded[member]]
        members += [inference.ready(network, path, device) for network in selected]
    inputs = [network.preprocess for network in members]
    if any(other != inputs[0] for other in inputs[1:]):
        raise ValueError(f"weights: the members of an ensemble must want the same input, got {inputs}")
    return members


def sha256(file: Path) -> str:
    """Hex digest of a file's content; of a directory's files and their names, but for hidden ones."""
    if file.is_dir():
        names = sorted(path.relative_to(file) for path in file.rglob("*") if path.is_file())
        shown = [name for name in names if not any(part.startswith(".") for part in name.parts)]
        listing = "\n".join(f"{name.as_posix()} {sha256(file / name)}" for name in shown)
        return hashlib.sha256(listing.encode()).hexdigest()
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _label(model: str, file: Path, network: DepthNetwork) -> str:
    """As tables show it: the name of the architecture, or of the file with the (first) weights."""
    if model == "trained":
        spec = read_info(file).spec
        if spec.module is not None:
            return Path(spec.module.source).name
        return "FastDepth" if spec.architecture == "fastdepth" else f"ResNet{spec.layers}-Monodepth2"
    if model == "fastdepth":
        return "FastDepth"
    if model == "monodepth2":
        return f"ResNet{network.layers}-Monodepth2" if isinstance(network, MonodepthResNet) else "Monodepth2"
    return "Depth Anything V2" if model == "depth_anything" else file.stem


def _path(file: str) -> tuple[str, int | None]:
    """A file and the member of it that is meant; None = all of them."""
    path, mark, number = file.rpartition("#")
    if mark and path and number.isdecimal() and not Path(file).exists():
        return path, int(number)
    return file, None
