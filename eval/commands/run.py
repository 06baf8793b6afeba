"""``ufmstar run``: its options, and the printed results."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from ufmstar_torch.config import SPGFConfig, UfMStarConfig
from ufmstar_torch.eval.commands.opening import SequenceOptions
from ufmstar_torch.eval.commands.options import (
    MachineOptions,
    as_dict,
    fields_of,
    option,
    parse,
    positional,
    usage_errors,
)  # fmt: skip
from ufmstar_torch.eval.commands.terminal import Bars, stop_signals
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.run.folder import FolderError
from ufmstar_torch.eval.run.job import RunJob, make_job
from ufmstar_torch.eval.run.machine import share_threads
from ufmstar_torch.eval.run.run import run
from ufmstar_torch.eval.run.summary import FINISHED, INTERRUPTED
from ufmstar_torch.eval.sequences.open import open_sequence
from ufmstar_torch.stateful import flat

PRESETS = ("tum", "tartanair_indoor", "tartanair_outdoor")
_OF_FOLDER = ("variance", "depth_scale", "map_intrinsics")
# Of UfM*'s settings, those that are off by default.
_SECTIONS = ("anchors", "confidence", "posterior", "merge")


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
        runtime: auto: ONNX Runtime for weights in ONNX files, torch for the rest; or one of the two
        precision: of the networks; bf16: torch's autocast
    """

    model: str | None = None
    weights: tuple[str, ...] = ()
    mode: str = option("alternate", choices=("alternate", "full"))
    samples: int | None = None
    offload: bool = False
    spec: str | None = None
    runtime: str = option("auto", choices=("auto", "torch", "onnx"))
    precision: str = option("float32", choices=("float32", "bf16"))


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


@dataclass(frozen=True, kw_only=True)
class UfMOptions:
    """UfM*.

    Attributes:
        preset: segmentation thresholds of the authors' code for a kind of recording; single --ufm.segment.* take
            precedence
        ufm_preset: paper: the paper's own settings (UfMStarConfig.paper), default: ours; --preset and single --ufm.*
            take precedence
        anchors: depths that show the error on which all views agree (docs/anchors.md). Without a word, or with corners:
            corners tracked in the images; dense: a depth in every cell of the image, searched in earlier images; FILE:
            landmarks, a line x y z sigma [m] each, in the world of the poses
        posterior: also a depth that anchors correct, with its variance (docs/results/posterior.md); --anchors chooses
            the anchors, default: dense
        scale_from: network: its scale for COLMAP poses without one; anchors then show shape only
        recalibration: file of `ufmstar recalibrate`, or none; default: WEIGHTS.recalibration.json beside the weights
    """

    preset: str | None = option(None, choices=PRESETS)
    ufm_preset: str | None = option(None, choices=("paper", "default"))
    anchors: bool | str = option(False, const=True)
    posterior: bool = False
    scale_from: str | None = option(None, choices=("network",))
    recalibration: str | None = None
    ufm: dict[str, Any] = fields_of(UfMStarConfig, "ufm.", defaults={"on_bad_frame": "skip"})

    @property
    def config(self) -> UfMStarConfig:
        """The configuration. Raises ValueError: settings of anchors or posterior without them."""
        sections: dict[str, Any] = {}
        for name, used in (("anchors", self.anchors or self.posterior), ("posterior", self.posterior)):
            if self.ufm[name] is not None and not used:
                raise ValueError(f"--ufm.{name}.* needs --{name}")
            sections[name] = (self.ufm[name] or {}) if used else None
        return UfMStarConfig.from_dict(self.ufm | sections)

    def preset_defaults(self) -> dict[str, Any]:
        """Other defaults than the options' own, by name, as ``preset`` and ``ufm_preset`` ask."""
        defaults: dict[str, Any] = {}
        if self.ufm_preset == "paper":
            changed = flat(UfMStarConfig.paper().to_dict()) | {"on_bad_frame": "skip"}
            defaults = {f"ufm.{name}": value for name, value in changed.items() if name not in _SECTIONS}
        if self.preset is not None:
            preset = SPGFConfig.preset(self.preset).to_dict()
            defaults |= {f"ufm.segment.{name}": value for name, value in preset.items()}
        return defaults


@dataclass(frozen=True, kw_only=True)
class RunOptions(MachineOptions):
    """Depth with a variance for every pixel of a sequence of posed images.

    The depth comes from a network (--model, --weights), from maps that another program predicted (--depth DIR), or
    from the sequence itself (--depth self).

    Attributes:
        sequence: folder of the sequence, or a video file, or tour:SEED for rendered rooms
        out: folder for everything that is written
        frames: START:STOP:STEP, which frames, counted from 0 as Python does
        resume: continue the run in --out
        overwrite: replace the run in --out
        no_video: leave preview.mp4 out
        no_sheet: leave contact_sheet.png out
        threads: number of CPU threads of network and step; default: all cores but one, which reads and writes
    """

    USAGE: ClassVar[str] = "ufmstar run SEQUENCE (--model NAME --weights FILE... | --depth DIR) --out OUT [options]"

    sequence: str = positional()
    out: str
    frames: str | None = None
    resume: bool = False
    overwrite: bool = False
    no_video: bool = False
    no_sheet: bool = False
    opening: SequenceOptions
    network: NetworkOptions
    maps: MapOptions
    uncertainty: UfMOptions

    def __post_init__(self) -> None:
        _ = self.config  # checks the settings
        _check_depth(as_dict(self.network) | as_dict(self.maps))
        if self.resume and self.overwrite:
            raise ValueError("--resume and --overwrite contradict each other")

    @property
    def config(self) -> UfMStarConfig:
        """The configuration of UfM*."""
        return self.uncertainty.config

    def settings(self) -> dict[str, Any]:
        """Return the options that define the result, as plain values of a configuration file."""
        started = ("resume", "overwrite", "debug")
        plain = {name: value for name, value in as_dict(self).items() if name not in started}
        ufm = {name: value for name, value in self.config.to_dict().items() if value or name not in _SECTIONS}
        return plain | {"ufm": ufm}


def read(words: Sequence[str]) -> RunOptions:
    """The options of a command line; errors as :func:`parse`."""
    options: RunOptions = read_ufm(RunOptions, words, "ufmstar run", {})
    return options


def read_ufm(kind: type[Any], words: Sequence[str], prog: str, own: Mapping[str, Any]) -> Any:
    """The options of a command with :class:`UfMOptions`, whose presets are defaults; ``own`` are the command's, by
    name. Errors as :func:`parse`."""
    options = parse(kind, words, prog, own)
    defaults = options.uncertainty.preset_defaults()
    return parse(kind, words, prog, {**defaults, **own}) if defaults else options


def main(options: RunOptions) -> int:
    """Run, and print the results' table; the exit code."""
    if options.threads is None:
        share_threads()
    with usage_errors(ImportError, OSError, ValueError):
        job = job_from(options)
    how = {"resume": options.resume, "overwrite": options.overwrite}
    with usage_errors(FolderError), Bars() as bars, stop_signals(bars.say) as stop:
        summary = run(job, options.out, **how, progress=bars.show, stop=stop)
    return _report(summary, options.out)


def job_from(options: RunOptions, networks: DepthSource | None = None) -> RunJob:
    """Open the sequence, and make the job that the options describe, with the networks of an earlier one; errors as
    ``open_sequence`` and ``make_job``."""
    sequence = open_sequence(options.sequence, **options.opening.given())
    return make_job(options.settings(), options.config, sequence, networks)


def _report(summary: Mapping[str, Any], out: str) -> int:
    """Print the table and where the outputs are; the exit code."""
    from ufmstar_torch.eval.report.text import run_table

    if summary["frames"]["done"]:
        print(run_table(summary))
    made = [name for name, reason in summary["outputs"].items() if reason is None]
    for name, reason in summary["outputs"].items():
        if reason is not None:
            print(f"no {name}: {reason}")
    print(f"{out}: {', '.join(['summary.json', 'frames.jsonl', 'frames/', 'depth/', 'sigma/', *made])}")
    state = f"ufmstar run: {summary['state']}: {summary['reason']}"
    if summary["state"] == FINISHED:
        print(state)
        return 0
    print(state, file=sys.stderr)
    return 130 if summary["state"] == INTERRUPTED else 1


def _check_depth(options: Mapping[str, Any]) -> None:
    """Check that the options name one source of depth, and nothing that belongs to another one. Raises ValueError."""
    model, depth = options["model"], options["depth"]
    if (model is None) == (depth is None):
        expected = "--model NAME --weights FILE for a network, or --depth DIR for maps that are already predicted"
        raise ValueError(f"the depth must come from one place: give {expected}" + (", not both" if model else ""))
    if model is not None and not options["weights"]:
        raise ValueError(f"--model {model} needs --weights FILE")
    of_folder = [name for name in _OF_FOLDER if options[name] not in (None, [])]
    needs_model = [name for name in ("weights", "spec", "samples", "offload") if options[name] and model is None]
    needs_trained = [name for name in ("samples", "offload") if options[name] and model != "trained"]
    needs_depth = [*of_folder, *(["size"] if options["size"] is not None else [])] if depth is None else []
    needs_folder = of_folder if depth in ("self", "ground-truth") else []
    wrong = ((needs_model, "--model"), (needs_trained, "--model trained"))
    for names, missing in (*wrong, (needs_depth, "--depth"), (needs_folder, "--depth DIR")):
        if names:
            raise ValueError(f"--{names[0].replace('_', '-')} goes with {missing} only")
    if options["mode"] == "full" and len(options["weights"]) < 2 and model != "trained":
        raise ValueError("--mode full needs several --weights")
    if options["samples"] is not None and (options["samples"] < 2 or options["mode"] != "full"):
        raise ValueError(f"--samples must be at least 2 and goes with --mode full, got {options['samples']}")
