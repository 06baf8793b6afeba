"""The options of depth and of UfM* that ``run``, ``rank`` and ``live`` share, and the loading of what they name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from ufmstar_torch.config import SPGFConfig, UfMStarConfig
from ufmstar_torch.eval.commands.options import MachineOptions, fields_of, option
from ufmstar_torch.eval.engine.load import NetworkChoice
from ufmstar_torch.eval.engine.maps import MapSource, folder_source, own_depth
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.methods.setting import DEFAULTS, PAPER, started
from ufmstar_torch.eval.sequences.frame import FrameSequence, parse_size
from ufmstar_torch.eval.sequences.intrinsics import parse_intrinsics
from ufmstar_torch.frames.warnings import LOGGER
from ufmstar_torch.models.any_network import PROGRAMS
from ufmstar_torch.models.inference import Inference
from ufmstar_torch.posterior.recalibrate import Recalibration, recalibration_path
from ufmstar_torch.runtime.stateful import flat

PRESETS = ("tum", "tartanair_indoor", "tartanair_outdoor")
OWN_DEPTH = ("self", "ground-truth")
# Sections that are off in ``UfMStarConfig()``.
SECTIONS = ("anchors", "confidence", "posterior", "merge")


@dataclass(frozen=True, kw_only=True)
class NetworkOptions:
    """Depth from networks.

    Attributes:
        model: kind of network: fastdepth, monodepth2, trained, depth_anything, huggingface, onnx, litert, torchscript
            or exported
        weights: file (depth_anything, huggingface: directory); several are the members of an ensemble
        mode: of an ensemble: one member per image in turn, or all on every image
        samples: passes per image of an mc_dropout network in mode full; default: 10
        offload: trained: keep the weights in host memory, only the member in turn on the device
        spec: JSON file that declares what the weights do not say: inputs, outputs, an alignment
        trust_code: exported, torchscript: let the file run its code; only for files whose origin you trust
        runtime: auto: ONNX Runtime for weights in ONNX files, torch for the rest; or one of the two
        precision: of the networks; bf16: torch's autocast
    """

    model: str | None = None
    weights: tuple[str, ...] = ()
    mode: str = option("alternate", choices=("alternate", "full"))
    samples: int | None = option(None, least=2)
    offload: bool = False
    spec: str | None = None
    trust_code: bool = option(False, typed=True)
    runtime: str = option("auto", choices=("auto", "torch", "onnx"))
    precision: str = option("float32", choices=("float32", "bf16"))

    def __post_init__(self) -> None:
        if self.model is not None and not self.weights:
            raise ValueError(f"--model {self.model} needs --weights FILE")
        for name in ("weights", "spec", "samples", "offload"):
            if getattr(self, name) and self.model is None:
                raise ValueError(f"--{name} goes with --model only")
        for name in ("samples", "offload"):
            if getattr(self, name) and self.model != "trained":
                raise ValueError(f"--{name} goes with --model trained only")
        if self.trust_code and self.model not in PROGRAMS:
            raise ValueError(f"--trust-code goes with --model {' or '.join(PROGRAMS)} only")
        if self.mode == "full" and len(self.weights) < 2 and self.model != "trained":
            raise ValueError("--mode full needs several --weights")
        if self.samples is not None and self.mode != "full":
            raise ValueError("--samples goes with --mode full only")

    def load(self, machine: MachineOptions) -> DepthSource:
        """Load the networks onto a device; errors as ``NetworkChoice.load``."""
        choice = NetworkChoice("", str(self.model), self.weights, self.spec, self.trust_code)
        inference = Inference(self.runtime, self.precision, machine.threads)
        how: dict[str, Any] = {"mode": self.mode, "samples": self.samples, "offload": self.offload}
        return choice.load(torch.device(machine.device), **how, inference=inference)


@dataclass(frozen=True, kw_only=True)
class MapOptions:
    """Depth from files, instead of a network.

    Attributes:
        depth: folder of predicted maps (16-bit PNG, EXR, npy), or an earlier run's output; 'self': the sequence's own
            depth
        variance: folder of variance maps [m^2] that belong to them
        depth_scale: metres per unit of the maps in the folder
        map_intrinsics: of the maps, if they do not show the whole image: a file, or fx fy cx cy [px]
        size: HxW [px], to which the maps are brought
    """

    depth: str | None = None
    variance: str | None = None
    depth_scale: float | None = None
    map_intrinsics: tuple[str, ...] = ()
    size: str | None = None

    def __post_init__(self) -> None:
        for name in ("variance", "depth_scale", "map_intrinsics", "size"):
            if getattr(self, name) in (None, ()):
                continue
            if self.depth is None or (self.depth in OWN_DEPTH and name != "size"):
                needed = "--depth" if self.depth is None else "--depth DIR"
                raise ValueError(f"--{name.replace('_', '-')} goes with {needed} only")
        parse_size(self.size)
        parse_intrinsics(self.map_intrinsics, "--map-intrinsics")

    def source(self, sequence: FrameSequence, indices: range) -> MapSource:
        """The maps of the frames ``indices``. Raises NotADirectoryError, ValueError: the folder does not exist, or maps
        are missing or do not fit."""
        size = parse_size(self.size)
        if self.depth in OWN_DEPTH:
            if len(sequence.without_depth) == len(sequence):
                raise ValueError(f"--depth {self.depth}: the sequence {sequence.name!r} has no depth maps")
            return own_depth(size)
        K = parse_intrinsics(self.map_intrinsics, "--map-intrinsics")
        how: dict[str, Any] = {"variance": self.variance, "scale": self.depth_scale, "intrinsics": K}
        return folder_source(sequence, str(self.depth), **how, size=size, indices=indices)


@dataclass(frozen=True, kw_only=True)
class UfMOptions:
    """UfM*.

    Attributes:
        preset: segmentation thresholds of the authors' code for a kind of recording; single --ufm.segment.* take
            precedence
        ufm_preset: paper: the paper's own settings (UfMStarConfig.paper; with --plain, its method), default: ours;
            --preset and single --ufm.* take precedence
        anchors: depths that show the error on which all views agree (docs/anchors.md): dense, a depth in every cell of
            the image, searched in earlier images; corners, tracked in the images; FILE, landmarks, a line x y z
            sigma [m] each, in the world of the poses; sensor (or sensor:stereo, sensor:tof), the recording's own
            depth, dense where it has none
        scale_from: network: its scale for COLMAP poses without one; anchors then show shape only
        recalibration: file of `ufmstar recalibrate`, or none; default: WEIGHTS.recalibration.json beside the weights
    """

    preset: str | None = option(None, choices=PRESETS)
    ufm_preset: str | None = option(None, choices=(PAPER, DEFAULTS))
    anchors: str | None = None
    scale_from: str | None = option(None, choices=("network",))
    recalibration: str | None = None
    ufm: dict[str, Any] = fields_of(UfMStarConfig, "ufm.", unset=True, shown=True)

    def __post_init__(self) -> None:
        self.config()  # checks the settings

    @property
    def posterior(self) -> bool:
        """True if anchors correct the depth."""
        return False

    def config(self, **first: Any) -> UfMStarConfig:
        """The configuration; ``first`` replaces values of the presets. Raises ValueError: an impossible value, or
        settings of anchors or posterior while these are off."""
        used = {"anchors": self.anchors is not None or self.posterior, "posterior": self.posterior}
        for name, needed in (("anchors", "--anchors"), ("posterior", "the posterior, as run and live without --plain")):
            if name in self.ufm and not used[name]:
                raise ValueError(f"--ufm.{name}.* needs {needed}")
        start = started(self.ufm_preset or DEFAULTS, **used).replace(on_bad_frame="skip")
        start = start if self.preset is None else start.replace(segment=SPGFConfig.preset(self.preset))
        return start.with_values(first | flat(self.ufm))

    def load_recalibration(
        self, config: UfMStarConfig, weights: tuple[str, ...], source: DepthSource
    ) -> Recalibration | None:
        """Read the recalibration of the option; by default that next to the weights, if it exists. A warning states if
        that one was fitted to UfM* alone, and is left out because ``config`` has anchors.

        Raises:
            FileNotFoundError: the named file does not exist.
            ValueError: the file is no recalibration, or was fitted with other settings or to another network.
        """
        name = self.recalibration
        if name == "none" or (name is None and not (weights and recalibration_path(weights[0]).is_file())):
            return None
        file = recalibration_path(weights[0]) if name is None else Path(name)
        try:
            recalibration = Recalibration.from_json(file)
            of_plain = bool(recalibration.ufm) and not recalibration.ufm.get("anchors")
            if name is None and of_plain and config.anchors is not None:
                LOGGER.warning("%s is not used: it was fitted to UfM* alone, which --plain runs", file)
                return None
            recalibration.require(config, ", ".join(one["name"] for one in source.identity.get("files", ())))
        except ValueError as error:
            raise ValueError(f"{file}: {error}; --recalibration none runs without it") from error
        return recalibration


@dataclass(frozen=True, kw_only=True)
class PosteriorOptions(UfMOptions):
    """UfM*, and the posterior that corrects its depth and variance with anchors.

    Attributes:
        anchors: from which the depth is corrected (docs/anchors.md): dense (default), a depth in every cell of the
            image, searched in earlier images; corners, tracked in the images; FILE, landmarks, a line x y z sigma
            [m] each, in the world of the poses; with run, sensor (or sensor:stereo, sensor:tof), the recording's own
            depth, dense where it has none
        plain: UfM* alone: the network's depth with the variance of UfM*; with --anchors, the variance has B
    """

    plain: bool = False

    @property
    def posterior(self) -> bool:
        """True if anchors correct the depth."""
        return not self.plain
