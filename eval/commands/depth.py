"""The options of depth and of UfM* that ``run``, ``rank`` and ``live`` share, and the loading of what they name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from ufmstar_torch.config import SPGFConfig, UfMStarConfig
from ufmstar_torch.eval.commands.options import (
    Count,
    File,
    Flag,
    MachineOptions,
    Number,
    Repeated,
    Text,
    Texts,
    assigned,
    one_of,
    require_least,
)
from ufmstar_torch.eval.methods.setting import started
from ufmstar_torch.eval.sequences.frame import FrameSequence, parse_size
from ufmstar_torch.eval.sequences.intrinsics import parse_intrinsics

if TYPE_CHECKING:
    from ufmstar_torch.eval.engine.maps import MapSource
    from ufmstar_torch.eval.engine.predictions import DepthSource
    from ufmstar_torch.posterior.recalibrate import Recalibration

OWN_DEPTH = ("self", "ground-truth")
# Sections that are off in ``UfMStarConfig()``.
SECTIONS = ("anchors", "confidence", "posterior", "merge")


@dataclass(frozen=True, kw_only=True)
class InferenceOptions:
    """Running of networks.

    Attributes:
        samples: Run an mc_dropout network this many times per image, where all passes are needed (default: 10).
        spec: This JSON file declares what the weights do not say: inputs, outputs, an alignment.
        trust_code: Let exported and torchscript files run their code; only for files whose origin you trust.
        runtime: Use torch or ONNX Runtime (auto: ONNX Runtime for weights in ONNX files).
        precision: Run the networks in this precision; bf16 is torch's autocast.
    """

    samples: Count = None
    spec: Text = None
    trust_code: Flag = False
    runtime: Literal["auto", "torch", "onnx"] = "auto"
    precision: Literal["float32", "bf16"] = "float32"

    def __post_init__(self) -> None:
        require_least(self, samples=2)


@dataclass(frozen=True, kw_only=True)
class WeightsOptions:
    """The files of networks.

    Attributes:
        model: The network is a fastdepth, monodepth2, trained, depth_anything, huggingface, onnx, torchscript or
            exported.
        weights: The file of its weights (depth_anything, huggingface: directory); several are an ensemble's members.
        mode: Run one member of an ensemble per image in turn, or all on every image.
        offload: Keep the weights of a trained ensemble in host memory, only the member in turn on the device.
    """

    model: Text = None
    weights: Texts = ()
    mode: Literal["alternate", "full"] = "alternate"
    offload: Flag = False


@dataclass(frozen=True, kw_only=True)
class NetworkOptions(InferenceOptions, WeightsOptions):  # the help lists the last base's options first
    """Depth from networks."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.model is not None and not self.weights:
            raise ValueError(f"--model {self.model} needs --weights FILE")
        for name in ("weights", "spec", "samples", "offload"):
            if getattr(self, name) and self.model is None:
                raise ValueError(f"--{name} goes with --model only")
        for name in ("samples", "offload"):
            if getattr(self, name) and self.model != "trained":
                raise ValueError(f"--{name} goes with --model trained only")
        if self.trust_code:
            self._require_program()
        if self.mode == "full" and len(self.weights) < 2 and self.model != "trained":
            raise ValueError("--mode full needs several --weights")
        if self.samples is not None and self.mode != "full":
            raise ValueError("--samples goes with --mode full only")

    def _require_program(self) -> None:
        """Raises ValueError: the kind of network is no program."""
        from ufmstar_torch.models.any_network import PROGRAMS

        if self.model not in PROGRAMS:
            raise ValueError(f"--trust-code goes with --model {' or '.join(PROGRAMS)} only")

    def load(self, machine: MachineOptions) -> DepthSource:
        """Load the networks onto a device; errors as ``NetworkChoice.load``."""
        import torch

        from ufmstar_torch.eval.engine.load import NetworkChoice
        from ufmstar_torch.models.inference import Inference

        choice = NetworkChoice("", str(self.model), self.weights, self.spec, self.trust_code)
        inference = Inference(self.runtime, self.precision, machine.threads)
        how: dict[str, Any] = {"mode": self.mode, "samples": self.samples, "offload": self.offload}
        return choice.load(torch.device(machine.device), **how, inference=inference)


@dataclass(frozen=True, kw_only=True)
class MapOptions:
    """Depth from files, instead of a network.

    Attributes:
        depth: Read predicted maps from this folder (16-bit PNG, EXR, npy, an earlier run's output), or the sequence's
            own depth (self).
        variance: Read their variances [m^2] from this folder.
        depth_scale: One unit of the maps is this many metres.
        map_intrinsics: Maps that do not show the whole image have this camera: a file, or fx fy cx cy [px].
        size: Bring the maps to this size, HxW [px].
    """

    depth: Text = None
    variance: Text = None
    depth_scale: Number = None
    map_intrinsics: Texts = ()
    size: Text = None

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
        from ufmstar_torch.eval.engine.maps import folder_source, own_depth

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
        preset: Segment with the thresholds of the authors' code for a kind of recording.
        ufm_preset: Start from the paper's own settings (UfMStarConfig.paper; with --plain, its method), or ours.
        set: Set a value of UfMStarConfig as NAME=VALUE, as segment.min_pixels=100; it wins over presets; repeatable.
        anchors: Measure the error on which all views agree (docs/anchors.md) with depths searched in earlier images
            (dense), corners tracked in the images (corners), landmarks from a FILE with a line x y z sigma [m] each,
            or the recording's own depth (sensor, sensor:stereo, sensor:tof).
        scale_from: Poses of COLMAP without a scale get the network's; anchors then show shape only.
        recalibration: Map the variance by this file of `ufmstar recalibrate`.
    """

    preset: Annotated[
        Literal["tum", "tartanair_indoor", "tartanair_outdoor"] | None,
        one_of("tum", "tartanair_indoor", "tartanair_outdoor"),
    ] = None
    ufm_preset: Literal["paper", "default"] = "default"
    set: Repeated = ()
    anchors: Text = None
    scale_from: Annotated[Literal["network"] | None, one_of("network")] = None
    recalibration: File = None

    def __post_init__(self) -> None:
        self.config()  # checks the settings

    @property
    def posterior(self) -> bool:
        """True if anchors correct the depth."""
        return False

    def config(self, **first: Any) -> UfMStarConfig:
        """The configuration; ``first`` replaces values of the presets. Raises ValueError: an impossible value, or
        settings of anchors or posterior while these are off."""
        values = assigned(self.set)
        used = {"anchors": self.anchors is not None or self.posterior, "posterior": self.posterior}
        for name, needed in (("anchors", "--anchors"), ("posterior", "the posterior, as run and live without --plain")):
            if not used[name] and any(key.startswith(f"{name}.") for key in values):
                raise ValueError(f"--set {name}.* needs {needed}")
        start = started(self.ufm_preset, **used).replace(on_bad_frame="skip")
        start = start if self.preset is None else start.replace(segment=SPGFConfig.preset(self.preset))
        return start.with_values(first | values)

    def load_recalibration(self, config: UfMStarConfig, source: DepthSource) -> Recalibration | None:
        """Read the recalibration of the option.

        Raises:
            FileNotFoundError: the file does not exist.
            ValueError: the file is no recalibration, or was fitted with other settings or to another network.
        """
        from ufmstar_torch.posterior.recalibrate import Recalibration

        if self.recalibration is None:
            return None
        try:
            recalibration = Recalibration.from_json(self.recalibration)
            recalibration.require(config, ", ".join(one["name"] for one in source.identity.get("files", ())))
        except ValueError as error:
            raise ValueError(f"--recalibration {self.recalibration}: {error}") from error
        return recalibration


@dataclass(frozen=True, kw_only=True)
class PosteriorOptions(UfMOptions):
    """UfM*, and the posterior that corrects its depth and variance with anchors.

    Attributes:
        anchors: Correct the depth (docs/anchors.md) with depths searched in earlier images (dense, the default),
            corners tracked in the images (corners), landmarks from a FILE with a line x y z sigma [m] each, or, with
            run, the recording's own depth (sensor, sensor:stereo, sensor:tof).
        plain: Leave the network's depth as it is, with the variance of UfM* alone; with --anchors, it includes B.
    """

    plain: Flag = False

    @property
    def chosen(self) -> bool:
        """True if the user chooses anchors, or settings of anchors or the posterior."""
        return self.anchors is not None or any(key.startswith(("anchors.", "posterior.")) for key in assigned(self.set))

    @property
    def posterior(self) -> bool:
        """True if anchors correct the depth."""
        return not self.plain
