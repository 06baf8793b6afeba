"""Recipes: the settings that determine the weights, and the named presets.

From the paper (Section VII): 224 x 224, 50 epochs, Adam with momentum 0.9, weight decay 1e-4, dropout 0.2 "for all
ResNet50-Monodepth2 and FastDepth models", ten members. All methods are therefore trained with decoder dropout; at test
time only mc_dropout samples with it. Table 1's .01 and .03 MB of aleatoric and evidential heads correspond to four
scales. The paper does not state the rest. The names of the networks in the authors' release of DecTrain
(mit-lean/DecTrain) state batch 4, learning rate 1e-4, 50 epochs and dropout .2, and its ResNet50 starts from ImageNet.
Other choices are ours.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from ufmstar_torch.eval.report.table import aligned
from ufmstar_torch.models.spec import MOST_MEMBERS, NetworkSpec
from ufmstar_torch.runtime.checked import Checked, choice, number
from ufmstar_torch.runtime.kinds import check_kinds

# Batch and learning rate of monodepth2 are DecTrain's; FastDepth was trained with eight images per step.
TRAINING: dict[str, dict[str, Any]] = {
    "monodepth2": {"learning_rate": 1e-4, "batch_size": 4, "schedule": "cosine"},
    "fastdepth": {"learning_rate": 1e-3, "batch_size": 8, "schedule": "cosine"},
}
# Number of uncertainty heads (scales), by architecture.
_SCALES = {"monodepth2": 4, "fastdepth": 1}
# For a new head on a frozen network, and for a whole pretrained network, which large steps would destroy.
OF_HEAD: dict[str, Any] = {"learning_rate": 1e-3, "batch_size": 8, "epochs": 10, "clip": 10.0}
OF_MODULE: dict[str, Any] = {**OF_HEAD, "learning_rate": 1e-5}


@dataclass(frozen=True)
class Recipe(Checked):
    """The settings that decide the weights, apart from the data and the seed.

    Attributes:
        network: what is trained; its size is the size of the samples.
        members: of an ensemble, each trained by itself (those of a BatchEnsemble belong to the network).
        epochs: passes over the training part.
        max_steps: optimizer steps of one member, at which the schedule ends; 0 = all steps of the epochs.
        batch_size: images per step, over all processes together.
        clip_frames: frames that follow one another, of which a batch consists; 1 = single images. From 2 on, the head
            learns the variance that UfM* computes in the loop from the network's own depth, instead of its error
            (``train.distil``).
        learning_rate: Adam's step size after the warm-up.
        schedule: of the learning rate: "cosine" (down to 0 at the last step) or "constant".
        warmup_steps: number of steps in which the learning rate rises linearly from 0.
        beta1: Adam's first momentum: the decay of the mean gradient.
        beta2: Adam's second momentum: the decay of the mean squared gradient.
        weight_decay: L2 penalty, which Adam adds to the gradient.
        clip: largest norm of the gradient, 0 = not clipped.
        average: decay per step of the running mean of the weights, which is the result then; 0 = no mean.
        split_batch: whether every image of a batch trains one member of a BatchEnsemble, as in its paper: the cost of
            one network. Otherwise it trains all of them, at N times the cost.
        half: whether the weights are stored in half precision at the end.

    Raises:
        ValueError: a value is impossible; the message names the field.
    """

    network: NetworkSpec = field(default_factory=NetworkSpec)
    members: int = number(1, "M", "networks", 1, MOST_MEMBERS)
    epochs: int = number(50, "N", "epochs", 1, 1e6)
    max_steps: int = number(0, "N", "steps", 0, 1e9)
    batch_size: int = number(8, "B", "images", 1, 1e5)
    clip_frames: int = number(1, "T", "frames", 1, 1000)
    learning_rate: float = number(1e-3, "lr", "1", 0, 10, open_low=True)
    schedule: str = choice("cosine", "constant")
    warmup_steps: int = number(0, "N", "steps", 0, 1e9)
    beta1: float = number(0.9, "beta_1", "1", 0, 1, open_high=True)
    beta2: float = number(0.999, "beta_2", "1", 0, 1, open_high=True)
    weight_decay: float = number(1e-4, "lambda", "1", 0, 10)
    clip: float = number(0.0, "|g|", "1", 0, 1e6)
    average: float = number(0.0, "d", "1", 0, 1, open_high=True)
    split_batch: bool = False
    half: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.network.method == "batch_ensemble" and self.members > 1:
            raise ValueError("Recipe.members must be 1 for a batch_ensemble: its members are Recipe.network.members")
        if self.clip_frames > 1 and self.network.method not in ("aleatoric", "mc_dropout"):
            raise ValueError(f"Recipe.clip_frames above 1 needs an aleatoric head, got method {self.network.method!r}")
        if self.batch_size % self.clip_frames:
            raise ValueError(
                f"Recipe.batch_size {self.batch_size} must be a multiple of clip_frames {self.clip_frames}"
            )
        if self.split_batch and not 1 < self.network.members <= self.batch_size:
            raise ValueError(
                "Recipe.split_batch needs a batch_ensemble with no more members than batch_size, got "
                f"{self.network.members} and {self.batch_size}"
            )

    def to_dict(self) -> dict[str, Any]:
        """The fields as plain values for JSON."""
        values = {**super().to_dict(), "network": self.network.to_dict()}
        if self.clip_frames == 1:
            del values["clip_frames"]  # equal to files that are older than the field
        return values

    def with_members(self, count: int) -> Recipe:
        """A copy with another number of members of the ensemble or BatchEnsemble."""
        if self.network.method == "batch_ensemble":
            return replace(self, network=replace(self.network, members=count))
        return replace(self, members=count)


# [1] Decoder dropout of all models in the paper.
DROPOUT = 0.2
# Second half of a preset's name -> the network's fields, members of the ensemble.
METHOD_ROWS: dict[str, tuple[dict[str, Any], int]] = {
    "depth-only": ({"method": "depth"}, 1),
    "aleatoric": ({"method": "aleatoric"}, 1),
    "evidential": ({"method": "evidential"}, 1),
    "mc-dropout": ({"method": "mc_dropout"}, 1),
    "ensemble": ({"method": "aleatoric"}, 10),
    "batch-ensemble": ({"method": "batch_ensemble", "members": 10}, 1),
}
# The recipe of the weights in the package: small enough for the package, fast enough for two cores.
_DEMO = Recipe(
    network=NetworkSpec(
        architecture="fastdepth",
        method="aleatoric",
        widths=0.4,
        positive="softplus",
        size=(160, 224),
        preprocess="resize",
    ),
    members=4,
    epochs=7,
    learning_rate=2e-3,
    warmup_steps=200,
    clip=10.0,
    average=0.999,
    half=True,
)
# Distillation of UfM*'s variance: clips of four frames, and no dropout, whose noise would count as disagreement.
_DISTILLED = Recipe(
    network=NetworkSpec(architecture="fastdepth", method="aleatoric", positive="softplus"),
    clip_frames=4,
    clip=10.0,
    **{**TRAINING["fastdepth"], "batch_size": 16},
)


def _paper(architecture: str, network: dict[str, Any], members: int) -> Recipe:
    scales = 1 if network["method"] == "depth" else _SCALES[architecture]
    spec = NetworkSpec(architecture=architecture, dropout=DROPOUT, head_scales=scales, **network)
    return Recipe(network=spec, members=members, **TRAINING[architecture])


PRESETS: dict[str, Recipe] = {
    f"{architecture}-{row}": _paper(architecture, network, members)
    for architecture in TRAINING
    for row, (network, members) in METHOD_ROWS.items()
} | {"fastdepth-ufmstar": _DISTILLED, "demo": _DEMO}


_SOURCES = """From the paper (Section VII): method, members, size, epochs, decay, dropout, Adam's momentum .9. From its
table 1: heads at four scales of monodepth2 (--set network.head_scales=1: one). From DecTrain, the authors' release:
monodepth2's batch and learning rate, and its start from ImageNet (--init imagenet). Ours: Adam's .999, the schedule,
fastdepth's batch and learning rate; dropout after the second convolution of a level (--set network.dropout_both=true:
after both); every image trains all members of a BatchEnsemble (--set split_batch=true: one each, with --batch-size 10
or more). fastdepth ends in a ReLU as published; --set network.positive=softplus is ours and better from scratch. The
presets demo and fastdepth-ufmstar, whose head learns UfM*'s variance, are ours."""


@check_kinds
def preset(name: str) -> Recipe:
    """A named recipe. Raises ValueError: there is no such preset."""
    if name not in PRESETS:
        raise ValueError(f"preset must be one of {', '.join(PRESETS)}, got {name!r}")
    return PRESETS[name]


def table() -> str:
    """The presets as a table, one per row, and the sources of their values."""
    columns = ("preset", "method", "members", "widths", "size", "epochs", "batch", "learning rate", "decay", "dropout")
    rows = [columns]
    for name, r in PRESETS.items():
        n = r.network
        members, size = max(r.members, n.members), f"{n.size[0]}x{n.size[1]}"
        widths = str(n.widths) if n.architecture == "fastdepth" else f"ResNet{n.layers}"
        training = (f"{r.epochs}", f"{r.batch_size}", f"{r.learning_rate:g} {r.schedule}", f"{r.weight_decay:g}")
        rows.append((name, n.method, f"{members}", widths, size, *training, f"{n.dropout:g}" if n.dropout else "-"))
    return "\n".join([*aligned(rows), "", _SOURCES])
