"""Depth sources from a user's files: for a base of a suite, or for ``ufmstar run``."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from ufmstar_torch.eval.engine.maps import TRUTH, own_depth
from ufmstar_torch.eval.engine.network_checks import check_members, without_sampling
from ufmstar_torch.eval.engine.networks import NetworkSource, stochastic
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.methods.method import BASES
from ufmstar_torch.eval.sequences.frame import Size, parse_size
from ufmstar_torch.frames.prediction import NetworksInTurn
from ufmstar_torch.models.any_network import PROGRAMS
from ufmstar_torch.models.dropout import SAMPLES
from ufmstar_torch.models.inference import Inference, runtime_of
from ufmstar_torch.models.load import DIRECTORIES, load_network, network_names
from ufmstar_torch.models.monodepth2 import MonodepthResNet
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.trained import load_trained, read_info

_FORM = "BASE=MODEL:FILE[,FILE...]"
_AS_USERS = Inference()
_VERSION = 4  # of the digests: increase it when predictions from the same files change


@dataclass(frozen=True)
class NetworkChoice:
    """Networks in files, as chosen by a user.

    Raises:
        ValueError: no such base or model, no files, or files that do not fit together.
    """

    base: str  # a key of ``method.BASES``; "" = any network, for ``ufmstar run``
    model: str  # a name that ``load_network`` accepts, or "ground-truth": for "depth_only", the sequence's depth
    # In the order of the members. "FILE#2" is member 2, counted from 0, of a file of "trained" ("FILE": all members); a
    # directory is a network of ``transformers``; for "ground-truth" empty, or "HxW".
    weights: tuple[str, ...] = ()
    spec: str | None = None  # file that declares what an ONNX file or saved program does not contain
    trust_code: bool = False  # True allows the files of "exported" and "torchscript" to run code

    def __post_init__(self) -> None:
        if not self.base:
            return
        if self.base not in BASES:
            raise ValueError(f"base must be one of {', '.join(BASES)}, got {self.base!r}; expected {_FORM}")
        if self.model == TRUTH:
            if self.base != "depth_only" or len(self.weights) > 1:
                raise ValueError("ground-truth goes with depth_only, as in depth_only=ground-truth[:HxW]")
            try:
                _ = self.size
            except ValueError as error:
                raise ValueError(f"ground-truth:HxW needs a size in pixels, got {self.weights[0]!r}") from error
            return
        if self.model not in network_names():
            names = ", ".join((*network_names(), TRUTH))
            raise ValueError(f"model must be one of {names}, got {self.model!r}; expected {_FORM}")
        if not self.weights:
            raise ValueError(f"{self.base}={self.model} needs the file of its weights: {_FORM}")

    @classmethod
    def parse(cls, text: str) -> NetworkChoice:
        """Parse ``BASE=MODEL:FILE[,FILE...]``; one FILE may be a spec (.json). Raises ValueError: another form."""
        base, equals, rest = text.partition("=")
        model, _, files = rest.partition(":")
        if not (base and equals and model):
            raise ValueError(f"a network must be given as {_FORM}, got {text!r}")
        listed = [file for file in files.split(",") if file]
        specs = [file for file in listed if file.endswith(".json")]
        if len(specs) > 1:
            raise ValueError(f"{base}={model} takes one spec, got {specs}")
        return cls(base, model, tuple(file for file in listed if file not in specs), specs[0] if specs else None)

    def with_spec(self, spec: str | None) -> NetworkChoice:
        """The choice with that spec, unless it has one or is the sequence's depth."""
        if spec is None or self.spec is not None or self.model == TRUTH:
            return self
        if not spec.endswith(".json"):
            raise ValueError(f"--spec must be a file *.json, got {spec!r}")
        return replace(self, spec=spec)

    @property
    def size(self) -> Size | None:
        """(h, w) to which ground truth is resized; None = not resized."""
        return parse_size(self.weights[0]) if self.model == TRUTH and self.weights else None

    def load(
        self,
        device: torch.device,
        *,
        mode: str = "alternate",
        samples: int | None = None,
        offload: bool = False,
        inference: Inference = _AS_USERS,
    ) -> DepthSource:
        """Load the depth source onto a device.

        Args:
            device: of the networks.
            mode: without a base, "alternate" for one member per image, "full" for all members, or all samples of a
                single network. With a base, the row decides.
            samples: of MC-Dropout; None = as many as in the paper's baseline.
            offload: see :meth:`members`.
            inference: runtime, precision and threads.

        Raises:
            FileNotFoundError, ValueError: as :meth:`members` and ``check_members``; mode "full" with one network that
                does not sample, or ``samples`` without such sampling.
        """
        if self.model == TRUTH:
            return own_depth(self.size)
        try:
            members = self.members(device, offload=offload, inference=inference)
        except ValueError as error:
            raise ValueError(f"{self.base}={self.model}: {error}" if self.base else str(error)) from error
        sampling = self.base == "mc_dropout" if self.base else len(members) == 1 and mode == "full"
        if self.base:
            members = members if sampling else [without_sampling(member) for member in members]
            check_members(self.base, members, device)
        elif sampling and not stochastic(members):
            text = "mode 'full' needs several members, or one with dropout that samples; there is one without"
            raise ValueError(text)
        elif samples is not None and not sampling:
            text = f"samples goes with mode 'full' and one network that samples, there are {len(members)}"
            raise ValueError(text)
        passes = (samples or SAMPLES) if sampling else None
        identity = self._identity(members, passes, inference) | ({} if self.base else {"mode": mode})
        contents = [(file["sha256"], file["member"]) for file in identity["files"]]
        if len(set(contents)) < len(contents):
            names = ", ".join(file["name"] for file in identity["files"])
            raise ValueError(f"weights: the members of an ensemble must differ, two of {names} are the same network")
        nameless = {"label": None, "files": [file | {"name": None} for file in identity["files"]]}
        content = json.dumps({**identity, **nameless, "device": device.type, "version": _VERSION}, sort_keys=True)
        digest = hashlib.sha256(content.encode()).hexdigest()
        turns = NetworksInTurn(members, samples=passes, preprocess=members[0].preprocess)
        how: dict[str, Any] = {"precision": inference.precision, "label": identity["label"], "digest": digest}
        return NetworkSource(turns, device, identity, **how)

    def members(
        self, device: torch.device, *, offload: bool = False, inference: Inference = _AS_USERS
    ) -> list[DepthNetwork]:
        """The networks in order, in eval mode and on the CPU, prepared to run on ``device`` with ``inference``.
        ``offload``, for "trained": weights stay in host memory, only the active member is on the device.

        Raises:
            FileNotFoundError: a file is missing.
            ValueError: unknown model, files that do not fit it, or members with different inputs.
        """
        named = [(Path(path), member) for path, member in map(_path, self.weights)]
        directories = self.model in DIRECTORIES
        for path, _ in named if directories else ():
            if not path.is_dir():
                fetch = "`hf download NAME --local-dir DIR` fetches a checkpoint from the hub"
                raise FileNotFoundError(f"no such directory: {path}; {fetch}")
        for path in (*(path for path, _ in named if not directories), *([Path(self.spec)] if self.spec else [])):
            if not path.is_file() and not (self.model == "monodepth2" and path.is_dir()):
                raise FileNotFoundError(f"no such file: {path}")
        members: list[DepthNetwork] = []
        how: dict[str, Any] = {} if self.spec is None else {"spec": self.spec}
        how |= {"trust_code": self.trust_code} if self.model in PROGRAMS else {}
        for path, member in named:
            if self.model == "trained" and not how:
                loaded = load_trained([path], offload=offload)
            else:
                try:
                    loaded = [load_network(self.model, path, **how, **inference.options(self.model, device))]
                except TypeError as error:
                    raise ValueError(f"model {self.model!r} does not take {sorted(how)}: {error}") from error
            if member is not None and member >= len(loaded):
                raise ValueError(f"{path} has {len(loaded)} members, there is no {member} (counted from 0)")
            selected = loaded if member is None else [loaded[member]]
            members += [inference.ready(network, path, device) for network in selected]
        inputs = [network.preprocess for network in members]
        if any(other != inputs[0] for other in inputs[1:]):
            raise ValueError(f"weights: the members of an ensemble must want the same input, got {inputs}")
        return members

    def _identity(self, members: Sequence[DepthNetwork], passes: int | None, inference: Inference) -> dict[str, Any]:
        """Plain values that distinguish the loaded networks."""
        named = [(Path(path), member) for path, member in map(_path, self.weights)]
        return {
            "model": self.model,
            "label": _label(self.model, named[0][0], members[0]),
            "files": [{"name": path.name, "sha256": sha256(path), "member": member} for path, member in named],
            "spec": None if self.spec is None else sha256(Path(self.spec)),
            "members": len(members),
            "samples": passes,
            # Settings that change the last bits of a prediction.
            "runtime": runtime_of(members[0], inference.precision)["name"],
            "precision": inference.precision,
        }


def sha256(file: Path) -> str:
    """Hex digest of a file's content, or of the names and contents of a directory's files except hidden ones."""
    if file.is_dir():
        names = sorted(path.relative_to(file) for path in file.rglob("*") if path.is_file())
        shown = [name for name in names if not any(part.startswith(".") for part in name.parts)]
        listing = "\n".join(f"{name.as_posix()} {sha256(file / name)}" for name in shown)
        return hashlib.sha256(listing.encode()).hexdigest()
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _label(model: str, file: Path, network: DepthNetwork) -> str:
    """The label in tables: the name of the architecture, or of the file with the (first) weights."""
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
    """Split "FILE#2" into the file and the member's number; None = all members."""
    path, mark, number = file.rpartition("#")
    if mark and path and number.isdecimal() and not Path(file).exists():
        return path, int(number)
    return file, None
