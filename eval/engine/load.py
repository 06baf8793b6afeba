"""Depth sources from files: a user's choice for a base of a suite, and the networks of ``ufmstar run``."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from ufmstar_torch.eval.engine.maps import MapSource, own_depth
from ufmstar_torch.eval.engine.network_checks import check_members, without_sampling
from ufmstar_torch.eval.engine.networks import NetworkSource, stochastic
from ufmstar_torch.eval.methods.method import BASES
from ufmstar_torch.eval.sequences.frame import Size, parse_size
from ufmstar_torch.models.dropout import SAMPLES
from ufmstar_torch.models.inference import Inference, runtime_of
from ufmstar_torch.models.load import DIRECTORIES, load_network, network_names
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.trained import load_trained, read_info
from ufmstar_torch.networks_in_turn import NetworksInTurn

TRUTH = "ground-truth"
_FORM = "BASE=MODEL:FILE[,FILE...]"
_CPU, _AS_USERS = torch.device("cpu"), Inference()
_VERSION = 3  # of the digests: raise it where predictions from the same files change


@dataclass(frozen=True)
class NetworkChoice:
    """A network for a base, as chosen by a user.

    Raises:
        ValueError: no such base or model, no files, or files that do not go together.
    """

    base: str  # a key of ``method.BASES``
    # a name that ``load_network`` accepts, or "ground-truth" (of "depth_only": the sequence's own depth, which shows
    # what a method makes of perfect depth).
    model: str
    # its weights, one or several files, in the order of the members. Of "trained", "FILE#2" is member 2 of the file
    # alone. A file .json is the spec that goes with the weights. Of "ground-truth" nothing, or "HxW".
    files: tuple[str, ...] = ()
    label: str = ""  # as shown; "" = derived from the files

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
    def parse(cls, text: str, label: str = "") -> NetworkChoice:
        """From ``BASE=MODEL:FILE[,FILE...]``. Raises ValueError: another form."""
        base, equals, rest = text.partition("=")
        model, _, files = rest.partition(":")
        if not (base and equals and model):
            raise ValueError(f"a network must be given as {_FORM}, got {text!r}")
        return cls(base, model, tuple(file for file in files.split(",") if file), label)

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
        """The depth source.

        An ensemble's or BatchEnsemble's members take turns: image i is member i mod N's. MC-Dropout draws one sample
        an image, or ``samples`` of them. Its sample n of frame i is seeded by i and n, so that it is the same whatever
        ran before, on one process or many; the first one is what ``ufmstar run`` draws.

        Args:
            device: where networks run.
            samples: MC-Dropout's, on every image of a row that needs all of them.
            inference: runtime and precision.

        Raises:
            FileNotFoundError, ValueError: as :func:`load_members`, or as ``check_members``.
        """
        if self.model == TRUTH:
            label = self.label or "ground truth"
            identity: dict[str, Any] = {"model": TRUTH, "label": label, "size": self.size}
            return own_depth(self.size, identity, label=label, digest=_digest(identity))
        members, sampling = self._members(inference, device), self.base == "mc_dropout"
        check_members(self.base, members, device)
        named = [(Path(path), member) for path, member in map(_path, self.weights)]
        files = [{"name": path.name, "sha256": sha256(path), "member": member} for path, member in named]
        spec = None if self.spec is None else sha256(Path(self.spec))
        run_by = _run_by(members, inference)
        made_of = {"model": self.model, "files": [file | {"name": None} for file in files], "spec": spec}
        drawn = {"samples": samples} if sampling else {}
        label = self.label or _label(self.model, named[0][0], members[0])
        identity = {
            "model": self.model, "label": label, "files": files, "spec": spec, "members": len(members),
            **run_by, **drawn,
        }  # fmt: skip
        turns = NetworksInTurn(members, samples=samples if sampling else None, preprocess=members[0].preprocess)
        return NetworkSource(
            turns,
            device,
            identity,
            seeding="sample" if sampling else None,
            label=label,
            precision=inference.precision,
            digest=_digest({**made_of, **run_by, **drawn, "device": device.type, "version": _VERSION}),
        )

    def _members(self, inference: Inference, device: torch.device) -> list[DepthNetwork]:
        """The members that the files hold, in their order, as they run."""
        try:
            members: list[DepthNetwork] = []
            for file in self.weights:
                path, member = _path(file)
                loaded = load_members(self.model, [path], spec=self.spec, inference=inference, device=device)
                if member is not None and member >= len(loaded):
                    raise ValueError(f"{path} has {len(loaded)} members, there is no {member} (counted from 0)")
                members += loaded if member is None else [loaded[member]]
            _require_same_input(members)
        except ValueError as error:
            raise ValueError(f"{self.base}={self.model}: {error}") from error
        return members if self.base == "mc_dropout" else [without_sampling(member) for member in members]


def network_source(
    model: str,
    weights: Iterable[str | Path],
    *,
    mode: str = "alternate",
    samples: int | None = None,
    spec: str | Path | None = None,
    inference: Inference = _AS_USERS,
    device: str = "cpu",
    **how: Any,
) -> NetworkSource:
    """One network, or the members of an ensemble, from files, as ``ufmstar run`` runs them.

    Args:
        model, weights, spec, inference, **how: as :func:`load_members` takes them.
        mode: "alternate" (one member per image in turn) or "full" (all of them on every image, or ``samples``
            passes of a network that samples).
        samples: None: as many as the paper's baseline.
        device: "cpu", "cuda", ...

    Raises:
        FileNotFoundError, ValueError: as :func:`load_members`; mode "full" of one network that does not sample, or
            ``samples`` for any other.
    """
    files, where = [Path(file) for file in weights], torch.device(device)
    members = load_members(model, files, spec=spec, inference=inference, device=where, **how)
    alone = len(members) == 1 and mode == "full"
    if alone and not stochastic(members):
        raise ValueError("mode 'full' needs several members, or one with dropout that samples; there is one without")
    if samples is not None and not alone:
        raise ValueError(f"samples goes with mode 'full' and one network that samples, there are {len(members)}")
    passes = (samples or SAMPLES) if alone else None
    identity = {
        "model": model,
        "weights": [{"name": file.name, "sha256": sha256(file)} for file in files],
        "mode": mode,
        "samples": passes,
        "spec": None if spec is None else sha256(Path(spec)),
        **_run_by(members, inference),
    }
    turns = NetworksInTurn(members, samples=passes, preprocess=members[0].preprocess)
    return NetworkSource(turns, where, identity, precision=inference.precision)


def load_members(
    model: str,
    files: Iterable[str | Path],
    *,
    spec: str | Path | None = None,
    offload: bool = False,
    inference: Inference = _AS_USERS,
    device: torch.device = _CPU,
) -> list[DepthNetwork]:
    """The networks in files, in their order, in eval mode and on the CPU.

    Args:
        model: a name that ``load_network`` accepts.
        files: one for each member (a directory for networks of ``transformers``); those of "trained" may hold several.
        spec: declares what an ONNX file or saved program does not say.
        offload: of "trained": weights stay in host memory and come to the device for their turn only.
        inference: runtime, precision and threads.
        device: where they will run.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: unknown model, files that do not fit it, members that want different inputs.
    """
    paths = [Path(file) for file in files]
    for folder in paths if model in DIRECTORIES else []:
        if not folder.is_dir():
            fetch = "`hf download NAME --local-dir DIR` fetches a checkpoint from the hub"
            raise FileNotFoundError(f"no such directory: {folder}; {fetch}")
    for file in [*(paths if model not in DIRECTORIES else []), *([Path(spec)] if spec is not None else [])]:
        if not file.is_file():
            raise FileNotFoundError(f"no such file: {file}")
    options: dict[str, Any] = {} if spec is None else {"spec": spec}
    members: list[DepthNetwork] = []
    for path in paths:
        how = options | inference.options(model, device)
        if model == "trained" and not how:
            loaded = load_trained([path], offload=offload)
        else:
            try:
                loaded = [load_network(model, path, **how)]
            except TypeError as error:
                raise ValueError(f"model {model!r} does not take {sorted(how)}: {error}") from error
        members += [inference.ready(network, path, device) for network in loaded]
    _require_same_input(members)
    return members


def _run_by(members: Iterable[DepthNetwork], inference: Inference) -> dict[str, str]:
    """Settings that change the last bits of a prediction, for the identity: runtime and precision."""
    first = runtime_of(next(iter(members)), inference.precision)
    return {"runtime": first["name"], "precision": inference.precision}


def _require_same_input(members: Iterable[DepthNetwork]) -> None:
    """Raises ValueError unless the members of an ensemble want the same input."""
    expected = [member.preprocess for member in members]
    if any(other != expected[0] for other in expected[1:]):
        raise ValueError(f"weights: the members of an ensemble must want the same input, got {expected}")


def sha256(file: Path) -> str:
    """Hex digest of a file's content; of a directory's files and their names, but for hidden ones (a download's)."""
    if file.is_dir():
        names = sorted(path.relative_to(file) for path in file.rglob("*") if path.is_file())
        shown = [name for name in names if not any(part.startswith(".") for part in name.parts)]
        listing = "\n".join(f"{name.as_posix()} {sha256(file / name)}" for name in shown)
        return hashlib.sha256(listing.encode()).hexdigest()
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _label(model: str, file: Path, network: DepthNetwork) -> str:
    """ "FastDepth", "ResNet50-Monodepth2", "Depth Anything V2", or the name of the file with the (first) weights."""
    if model == "trained":
        spec = read_info(file).spec
        return "FastDepth" if spec.architecture == "fastdepth" else f"ResNet{spec.layers}-Monodepth2"
    if model == "fastdepth":
        return "FastDepth"
    if model == "monodepth2":
        return f"ResNet{getattr(network, 'layers', 50)}-Monodepth2"
    return "Depth Anything V2" if model == "depth_anything" else file.stem


def _path(file: str) -> tuple[str, int | None]:
    """A file and the member of it that is meant; None = all of them."""
    path, mark, number = file.rpartition("#")
    if mark and path and number.isdecimal() and not Path(file).exists():
        return path, int(number)
    return file, None


def _digest(values: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
