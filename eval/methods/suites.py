"""The suites there are: the paper's tables and figures, and ablations of UfM*'s settings."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

from ufmstar_torch.eval.methods.method import ALONE, BASES, MANY, UFM, UFM_STAR, Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import DEFAULT, TRACKED, TRUTH
from ufmstar_torch.eval.methods.suite import Suite, default_of, rows_of, setting_from

# The paper's five, in its order; "depth_only" is of its third table.
_PAPER = ("ensemble", "mc_dropout", "batch_ensemble", "evidential", "aleatoric")
_RESNET = "ResNet50-Monodepth2"
_ANCHORED: Mapping[str, Any] = {"anchors": TRACKED}
_OUTDOORS = ("scannet", "tartanair", "kitti360")

# Of the paper's figures of noise and overlap. Its text does not print the noise's values: degrees and metres that go
# from what a SLAM system errs by to what makes poses useless.
ROTATIONS = (0.0, 0.5, 1.0, 2.0, 5.0, 10.0)
TRANSLATIONS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2)
SKIPS = (0, 1, 2, 4, 8, 16, 32)
# Drift, from what a good SLAM system errs by: 2 mm and .1 degrees per square root of frames are 11 mm and half a degree
# after a second at 30 frames a second.
ROTATION_DRIFTS = (0.02, 0.05, 0.1, 0.2, 0.5)
TRANSLATION_DRIFTS = (0.001, 0.002, 0.005, 0.01, 0.02)
# Of anchors: how many, noise where they are tracked [px], and the noise on poses that goes with them.
COUNTS = (0, 5, 20, 100, 300)
TRACK_NOISES = (1.0, 2.0, 4.0, 8.0)

# The two readings of what is too small: SPGF's own, and the paper's words.
_SPGF = {"segment.min_pixels": 200, "segment.min_rows": 16}
_LITERAL = {"segment.min_pixels": 2000, "segment.min_rows": 32}
_LENGTHS = ("segment.line_thresh", "segment.min_gaussian_length")
# What each ablation of a setting tries. UfM*'s own settings go before them, whether or not they are among them.
_SETTINGS: dict[str, tuple[str, tuple[Mapping[str, Any], ...]]] = {
    "segmentation": (
        "pruning of small Gaussians, and the size up to which they grow",
        (
            *({**size, "segment.prune": rule} for size in (_SPGF, _LITERAL) for rule in ("both", "either")),
            {"segment.prune": "none"},
            *({name: factor * default_of(name)} for name in _LENGTHS for factor in (0.5, 1.0, 2.0)),
        ),
    ),
    "eta": ("overlap from which two Gaussians correspond", tuple({"eta": v} for v in (0.1, 0.3, 0.5, 0.7, 0.9))),
    "eta-occlusion": ("occlusion filter", tuple({"eta_occlusion": v} for v in (0.3, 0.5, 0.7, 0.9, 1.0))),
    "ema-alpha": ("smoothing over time, 1 = none", tuple({"ema_alpha": v} for v in (0.1, 0.25, 0.5, 0.75, 1.0))),
    "prior": (
        "weight and mean of the regression's prior",
        (
            *({"prior_weight": v} for v in (0.01, 0.1, 1.0, 10.0, 100.0, 1000.0)),
            *({"prior_mean": v} for v in (0.001, 0.01, 0.1)),
        ),
    ),
    "overlap-weighted": ("disagreement weighted by overlap", tuple({"overlap_weighted": v} for v in (False, True))),
    "regression": (
        "exact sum or the paper's neighbourhood",
        tuple({"regression": v} for v in ("exact", "neighbourhood")),
    ),
}


def suite_named(name: str, base: str | None = None) -> Suite:
    """A suite by name.

    Args:
        name: one of ``names()``.
        base: the network that a figure or ablation is about, instead of its own; a key of ``method.BASES``.

    Raises:
        ValueError: no suite is called so, no such base, or the suite is about several bases.
    """
    if name in _TABLES:
        if base is not None:
            raise ValueError(f"--base goes with figures and ablations, {name} is a table of several bases")
        return _TABLES[name]()
    if name not in _FIGURES:
        raise ValueError(f"no suite is called {name!r}: there are {', '.join(names())}, and TOML files (*.toml)")
    if base is not None and base not in BASES:
        raise ValueError(f"--base must be one of {', '.join(BASES)}, got {base!r}")
    make, own = _FIGURES[name]
    return make(base or own)


def names() -> tuple[str, ...]:
    """All suites' names."""
    return (*_TABLES, *_FIGURES)


def listing() -> str:
    """A line for each suite: name, rows, what it is."""
    suites = [suite_named(name) for name in names()]
    return "\n".join(f"{suite.name:26}{len(suite.rows):3} rows  {suite.title}" for suite in suites)


def _table_1() -> Suite:
    rows = [row for base in _PAPER for row in _quartet(base)]
    title = "Table 1: uncertainty quality of five networks alone, with UfM, UfM-100K and UfM*"
    return _paper("paper-table-1", title, rows)


def _table_2() -> Suite:
    rows = [row for base in ("ensemble", "aleatoric") for row in _quartet(base)]
    title = "Table 2: latency, power, energy and memory of uncertainty"
    return replace(_paper("paper-table-2", title, rows), efficiency=True)


def _table_3() -> Suite:
    rows = rows_of(["UfM-DepthOnly-300K", "UfM*-DepthOnly-fixed-param", "UfM*-DepthOnly"])
    title = "Table 3: after the fact, on Depth Anything V2 at 518x518"
    return replace(_paper("paper-table-3", title, rows), network="Depth Anything V2-small", size=(518, 518))


def _table_4() -> Suite:
    rows = [Row(method) for base in MANY for method in (Method(base, UFM_STAR, full=True), Method(base, UFM_STAR))]
    return _paper("paper-table-4", "Table 4: every member on every image, beside one in turn", rows)


def _depth_only() -> Suite:
    return Suite("depth-only", "A network of depth alone: itself, UfM, UfM-100K, UfM*", tuple(_quartet("depth_only")))


def _all_methods() -> Suite:
    rows = []
    for base in BASES:
        rows += [*_quartet(base)[:3], Row(Method(base, UFM, max_points=300_000)), Row(Method(base, UFM_STAR))]
        rows.append(Row(Method(base, UFM_STAR, fixed_param=True)))
        rows += [Row(Method(base, fusion, full=True)) for fusion in (UFM, UFM_STAR) if base in MANY]
    return Suite("all-methods", "Every method of every network", tuple(rows))


def _pose_noise(base: str) -> Suite:
    points = [
        {},
        *({"rotation_noise": v} for v in ROTATIONS if v),
        *({"translation_noise": v} for v in TRANSLATIONS if v),
    ]
    rows = [Row(Method(base)), *_points(base, points)]
    suite = _paper("paper-figure-pose-noise", "Noise on the poses' rotation and translation", rows)
    return replace(suite, sweep=("rotation_noise", "translation_noise"))


def _overlap(base: str) -> Suite:
    settings = [setting_from({"skip": skip}) for skip in SKIPS]
    rows = [Row(method, s) for s in settings for method in (Method(base), Method(base, UFM_STAR))]
    return replace(_paper("paper-figure-overlap", "Images left out between two views", rows), sweep=("skip",))


def _entropy(base: str) -> Suite:
    rows = rows_of([Method(base), Method(base, UFM_STAR)])
    return replace(_paper("paper-figure-entropy", "Predictive entropy by data set", rows), datasets=_OUTDOORS)


def _anchors(base: str) -> Suite:
    overlap = {"disagreement": "overlap"}
    anchored = (_ANCHORED, {**overlap, **_ANCHORED}, {**_ANCHORED, "corrected": True}, {"anchors": TRUTH})
    rows = [Row(Method(base)), *_points(base, [{}, overlap, *anchored])]
    return Suite("anchors", "UfM* without and with anchors, and what disagreement compares", tuple(rows))


def _all_anchored() -> Suite:
    """Both disagreements, without and with anchors, of every network."""
    overlap = {"disagreement": "overlap"}
    points: tuple[Mapping[str, Any], ...] = ({}, overlap, _ANCHORED, {**overlap, **_ANCHORED})
    rows = [row for base in BASES for row in (Row(Method(base)), *_points(base, points))]
    return Suite("all-anchored", "UfM* without and with anchors, of every network", tuple(rows))


def _ablation_anchors(base: str) -> Suite:
    """Noise and drift of poses with anchors and without, and what is particular to anchors."""
    noises = [{"rotation_noise": v} for v in ROTATIONS if v] + [{"translation_noise": v} for v in TRANSLATIONS if v]
    noises += [{"rotation_drift": v} for v in ROTATION_DRIFTS] + [{"translation_drift": v} for v in TRANSLATION_DRIFTS]
    points: list[Mapping[str, Any]] = [{}, _ANCHORED]
    points += [{"anchors": TRUTH, "anchor_count": count} for count in COUNTS]
    points += [{**_ANCHORED, "anchor_count": count} for count in (5, 20)]
    points += [{**_ANCHORED, "track_noise": v} for v in TRACK_NOISES]
    points += [{**_ANCHORED, "anchor_half_life": v} for v in (10.0, 100.0)]
    points += [{**_ANCHORED, "anchor_shrinkage": v} for v in (1.0, 5.0, 20.0)]
    points += [{**more, **noise} for noise in noises for more in ({}, _ANCHORED)]
    # What anchors a row does not vary along a figure: it has a line for each.
    sweep = tuple(name for name in _varied(points) if name != "anchors")
    return Suite("ablation-anchors", "Ablation: anchors", tuple(_points(base, points)), sweep=sweep)


def _no_alternating(base: str) -> Suite:
    if base not in MANY:
        raise ValueError(f"ablation-no-alternating is of networks that take turns: {', '.join(MANY)}; got {base!r}")
    methods = (Method(base), Method(base, UFM_STAR), Method(base, UFM_STAR, full=True))
    title = "Ablation: one member in turn, or all on every image"
    return Suite("ablation-no-alternating", title, rows_of(methods))


def _ablation(what: str) -> Callable[[str], Suite]:
    title, points = _SETTINGS[what]

    def make(base: str) -> Suite:
        rows = [Row(Method(base)), *_points(base, [{}, *points])]
        return Suite(f"ablation-{what}", f"Ablation: {title}", tuple(rows), sweep=_varied(points))

    return make


def _ablations(base: str) -> Suite:
    """The rows of every ablation, each once."""
    made = [make(base) for make in (_ablation(what) for what in _SETTINGS)] + [_ablation_anchors(base)]
    made += [_overlap(base), _pose_noise(base), *([_no_alternating(base)] if base in MANY else [])]
    rows = dict.fromkeys(row for suite in made for row in suite.rows)
    sweep = dict.fromkeys(name for suite in made for name in suite.sweep)
    return Suite("ablations", "All ablations of one network", tuple(rows), sweep=tuple(sweep))


def _paper(name: str, title: str, rows: Iterable[Row]) -> Suite:
    """As the paper evaluates: 100 random ScanNet sequences, 224 x 224."""
    return Suite(name, title, tuple(rows), datasets=("scannet",), sequences=100, network=_RESNET, size=(224, 224))


def _quartet(base: str) -> list[Row]:
    """As in the paper's tables: alone, UfM, UfM-100K, UfM*."""
    methods = (
        Method(base, ALONE),
        Method(base, UFM),
        Method(base, UFM, max_points=100_000),
        Method(base, UFM_STAR),
    )
    return list(rows_of(methods))


def _points(base: str, points: Iterable[Mapping[str, Any]]) -> list[Row]:
    """UfM* at each point, each once (one that is UfM*'s own setting is the default row)."""
    settings = dict.fromkeys(setting_from(point) if point else DEFAULT for point in points)
    return [Row(Method(base, UFM_STAR), setting) for setting in settings]


def _varied(points: Iterable[Mapping[str, Any]]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for point in points for name in point))


_TABLES: dict[str, Callable[[], Suite]] = {
    "paper-table-1": _table_1,
    "paper-table-2": _table_2,
    "paper-table-3": _table_3,
    "paper-table-4": _table_4,
    "depth-only": _depth_only,
    "all-methods": _all_methods,
    "all-anchored": _all_anchored,
}
# With the base that the paper draws; it has no figures of the ablations, whose base is its main method's.
_FIGURES: dict[str, tuple[Callable[[str], Suite], str]] = {
    "paper-figure-pose-noise": (_pose_noise, "ensemble"),
    "paper-figure-overlap": (_overlap, "aleatoric"),
    "paper-figure-entropy": (_entropy, "ensemble"),
    "anchors": (_anchors, "depth_only"),
    "ablation-anchors": (_ablation_anchors, "depth_only"),
    "ablation-no-alternating": (_no_alternating, "ensemble"),
    **{f"ablation-{what}": (_ablation(what), "ensemble") for what in _SETTINGS},
    "ablations": (_ablations, "ensemble"),
}
