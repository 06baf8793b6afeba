"""The recipes: what is trained and how, one named table row each.

From the paper (Section V-A): 224 x 224, 50 epochs, Adam with betas (0.9, 0.999), weight decay 1e-4, dropout
0.2 "for all ResNet50-Monodepth2 and FastDepth models", ten members. All methods are therefore trained with decoder
dropout; at test time only mc_dropout samples by it. The paper does not state the learning rate, its schedule or the
batch size; those are ours and stand in :data:`OURS`, nowhere else.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, get_type_hints

from ufmstar_torch.models.spec import NetworkSpec

# Of an encoder that starts from ImageNet, and of one that starts from nothing: small steps keep what the former
# knows, the latter has nothing to lose. Eight images a step are what FastDepth was trained with.
OURS: dict[str, dict[str, Any]] = {
    "monodepth2": {"learning_rate": 1e-4, "batch_size": 8, "schedule": "cosine"},
    "fastdepth": {"learning_rate": 1e-3, "batch_size": 8, "schedule": "cosine"},
}
SCHEDULES = ("cosine", "constant")
# Of an ensemble; seeds of two trainings lie that far apart (``train.member.Job.seed``).
MOST_MEMBERS = 1000


@dataclass(frozen=True)
class Recipe:
    """Everything that decides what weights come out, apart from the data and the seed.

    Attributes:
        network: what is trained; its size is what the data are brought to.
        members: of an ensemble, each trained for itself (those of a BatchEnsemble are the network's own).
        epochs: passes over the training part.
        max_steps: optimizer steps of one member, with which the schedule then ends; 0 = all of the epochs.
        batch_size: images per step, over all processes together.
        learning_rate: at the start, after the warm-up.
        schedule: "cosine" (down to 0 at the last step) or "constant".
        warmup_steps: over which the learning rate rises linearly from 0.
        beta1, beta2: of Adam.
        weight_decay: L2 penalty, as Adam adds it to the gradient.
        clip: the gradient's largest norm, 0 = not clipped.
        average: decay per step of the running mean of the weights, which then are the result; 0 = none.
        half: whether the weights are stored in half precision at the end.

    Raises:
        ValueError: a value is impossible; the message names the field.
    """

    network: NetworkSpec = field(default_factory=NetworkSpec)
    members: int = 1
    epochs: int = 50
    max_steps: int = 0
    batch_size: int = 8
    learning_rate: float = 1e-3
    schedule: str = "cosine"
    warmup_steps: int = 0
    beta1: float = 0.9
    beta2: float = 0.999
    weight_decay: float = 1e-4
    clip: float = 0.0
    average: float = 0.0
    half: bool = False

    def __post_init__(self) -> None:
        if self.schedule not in SCHEDULES:
            raise ValueError(f"Recipe.schedule must be one of {', '.join(SCHEDULES)}, got {self.schedule!r}")
        for name, (low, high, ends) in _RANGES.items():
            value = getattr(self, name)
            inside = low < value < high or (value == low and ends[0] == "[") or (value == high and ends[1] == "]")
            if isinstance(value, bool) or not inside:
                raise ValueError(f"Recipe.{name} must be in {ends[0]}{low:g}, {high:g}{ends[1]}, got {value}")
        if self.network.method == "batch_ensemble" and self.members > 1:
            raise ValueError("Recipe.members must be 1 for a batch_ensemble: its members are Recipe.network.members")

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Recipe:
        """From plain values, "network" being what ``NetworkSpec.from_dict`` takes.

        Raises:
            ValueError: an unknown key, a wrong type or an impossible value.
        """
        types = get_type_hints(cls)
        if unknown := sorted(set(values) - set(types)):
            raise ValueError(f"Recipe has no {unknown}; it has {sorted(types)}")
        plain = dict(values)
        if isinstance(plain.get("network"), Mapping):
            plain["network"] = NetworkSpec.from_dict(plain["network"])
        for name, value in plain.items():
            wanted = types[name]
            if not isinstance(value, wanted) and not (wanted is float and isinstance(value, int)):
                raise ValueError(f"Recipe.{name} must be {wanted.__name__}, got {value!r}")
        return cls(**plain)

    def to_dict(self) -> dict[str, Any]:
        """The fields as plain values for JSON."""
        return {**asdict(self), "network": self.network.to_dict()}

    def with_members(self, count: int) -> Recipe:
        """The same with another number of members, of the ensemble or of the BatchEnsemble."""
        if self.network.method == "batch_ensemble":
            return replace(self, network=replace(self.network, members=count))
        return replace(self, members=count)


# Field -> smallest and largest value, and whether each is allowed itself.
_RANGES: dict[str, tuple[float, float, str]] = {
    "members": (1, MOST_MEMBERS, "[]"),
    "epochs": (1, 1e6, "[]"),
    "max_steps": (0, 1e9, "[]"),
    "batch_size": (1, 1e5, "[]"),
    "learning_rate": (0, 10, "(]"),
    "warmup_steps": (0, 1e9, "[]"),
    "beta1": (0, 1, "[)"),
    "beta2": (0, 1, "[)"),
    "weight_decay": (0, 10, "[]"),
    "clip": (0, 1e6, "[]"),
    "average": (0, 1, "[)"),
}
# [1] Decoder dropout of every model that the paper trains.
_DROPOUT = 0.2
# Second half of a preset's name -> the network's fields, members of the ensemble.
_METHOD_ROWS: dict[str, tuple[dict[str, Any], int]] = {
    "depth-only": ({"method": "depth"}, 1),
    "aleatoric": ({"method": "aleatoric"}, 1),
    "evidential": ({"method": "evidential"}, 1),
    "mc-dropout": ({"method": "mc_dropout"}, 1),
    "ensemble": ({"method": "aleatoric"}, 10),
    "batch-ensemble": ({"method": "batch_ensemble", "members": 10}, 1),
}
# What trains the checkpoint that the package ships: small enough to be sent along, quick enough for two cores.
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


def _paper(architecture: str, network: dict[str, Any], members: int) -> Recipe:
    spec = NetworkSpec(architecture=architecture, dropout=_DROPOUT, **network)
    return Recipe(network=spec, members=members, **OURS[architecture])


PRESETS: dict[str, Recipe] = {
    f"{architecture}-{row}": _paper(architecture, network, members)
    for architecture in OURS
    for row, (network, members) in _METHOD_ROWS.items()
} | {"demo": _DEMO}


def preset(name: str) -> Recipe:
    """A named recipe.

    Raises:
        ValueError: there is no such preset.
    """
    if name not in PRESETS:
        raise ValueError(f"preset must be one of {', '.join(PRESETS)}, got {name!r}")
    return PRESETS[name]


def table() -> str:
    """The presets as a table, one a row."""
    columns = ("preset", "method", "members", "widths", "size", "epochs", "batch", "learning rate", "decay", "dropout")
    rows = [columns]
    for name, r in PRESETS.items():
        n = r.network
        members, size = max(r.members, n.members), f"{n.size[0]}x{n.size[1]}"
        widths = str(n.widths) if n.architecture == "fastdepth" else f"ResNet{n.layers}"
        training = (f"{r.epochs}", f"{r.batch_size}", f"{r.learning_rate:g} {r.schedule}", f"{r.weight_decay:g}")
        rows.append((name, n.method, f"{members}", widths, size, *training, f"{n.dropout:g}" if n.dropout else "-"))
    spaces = [max(len(row[i]) for row in rows) for i in range(len(columns))]
    return "\n".join("  ".join(cell.ljust(s) for cell, s in zip(row, spaces, strict=True)).rstrip() for row in rows)


FIELDS = tuple(f.name for f in fields(Recipe) if f.name not in ("network", "members"))
