"""A row of a suite: a method with a setting."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ufmstar_torch.eval.methods.method import ALONE, NETWORKS, UFM_STAR, Method
from ufmstar_torch.eval.methods.setting import CORNERS, DEFAULT, DENSE, TRUTH, Setting, configured, setting_from


@dataclass(frozen=True)
class Row:
    """A method with a setting."""

    method: Method
    setting: Setting = DEFAULT  # the changes of an ablation
    # Title in tables and figures; "" = named by method and setting. Ignored when rows are compared.
    title: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        method, setting = self.method, self.setting
        if setting.of_ufm_star and method.fusion != UFM_STAR:
            raise ValueError(f"row {method.name}: only UfM* has {', '.join(setting.of_ufm_star)}")
        if setting.overrides.get("variances_in_h") and not method.uses_aleatoric:
            raise ValueError(f"row {method.name}: variances_in_h needs a network that predicts a variance")
        try:
            configured(setting)
        except ValueError as error:
            raise ValueError(f"row {method.name}: {error}") from error

    @property
    def needs(self) -> str:
        """The network, poses, anchors and files of the row. Every row also needs ground truth."""
        setting, parts = self.setting, [f"{NETWORKS[self.method.base]} ({self.method.base})"]
        if self.method.fusion != ALONE:
            parts.append("poses")
        if setting.anchors in (CORNERS, DENSE):
            parts.append("OpenCV")
        elif setting.anchors not in ("", TRUTH):
            parts.append(f"{setting.anchors} in each sequence")
        return ", ".join([*parts, "ground truth"])

    @property
    def slug(self) -> str:
        """A name for files: "UfMstar-Ensemble"; "UfMstar-Ensemble@0c3f..." if the setting is not the default."""
        name, setting = self.method.name.replace("*", "star"), self.setting.slug
        return f"{name}@{setting}" if setting else name

    @property
    def label(self) -> str:
        """The displayed name: "UfM*-Ensemble", "UfM*-Ensemble (ema_alpha 1.0, posterior)"."""
        return self.label_without()

    def label_without(self, *settings: str) -> str:
        """The displayed name without some settings."""
        values = {name: value for name, value in self.setting.to_dict().items() if name not in settings}
        changed = ", ".join(name if value is True else f"{name} {value}" for name, value in values.items())
        return f"{self.method.name} ({changed})" if changed else self.method.name

    def to_dict(self) -> dict[str, Any]:
        """The row as plain values for eval.json."""
        named = {"label": self.title} if self.title else {}
        return {"method": self.method.name, "setting": self.setting.to_dict(), **named}


def row_from(values: Mapping[str, Any]) -> Row:
    """The inverse of :meth:`Row.to_dict`. Raises KeyError, TypeError, ValueError: there is no such row."""
    setting = setting_from(values.get("setting", {}))
    return Row(Method.parse(values["method"]), setting, str(values.get("label", "")))


def plain_rows(rows: Iterable[Row]) -> list[Row]:
    """The first row of each method without ablated settings; in the paper's suites it has the paper's settings."""
    first: dict[Method, Row] = {}
    for row in rows:
        if row.setting.plain:
            first.setdefault(row.method, row)
    return list(first.values())
