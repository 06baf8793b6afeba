"""The constants of the posterior's model, one place for all tiers."""

from __future__ import annotations

from typing import NamedTuple


class Model(NamedTuple):
    """Lengths are in widths of the image; y = log(g/d).

    Attributes:
        side: most nodes in a row and in a column.
        flat, edge: variance of the difference of y between neighbouring nodes, ``flat + edge D^2`` with D their
            difference of log d: on rendered tours the variogram of y over one cell is .003 to .005 where D < .05, and
            grows as D^2.
        climb, smooth: length of a link, a cell and ``climb`` times the depth edge beyond ``smooth``, by which log d
            changes on a slanted surface. On tours the error grows with both by about 1 to 2.
        kappa: precision of f at a node, over the amplitude.
        hats: columns and rows of the coarse hats among the features.
        hat: variance of a hat, times the amplitude.
        prior, drift: standard deviation of the coefficients of 1, log d, u and v before the first anchor, and of their
            change from frame to frame: those of the true error on tours.
        inflation: factor of the field's variance and the roughness; what outliers add is counted apart.
        common: variance of y that all nodes share: the scale of the poses.
        limit: largest distance from evidence that counts.
        growth: variance of y by distance from evidence, beyond what held-out anchors show: they lie where there is
            texture.
        claimed, far: share of the variance that UfM* claims, from this distance on; less in proportion nearer.
        wrong, other: probability that the field's local correction does not hold at a node: on evidence, since that
            may be wrong, and what is added to it from the distance ``far`` on, since another surface may begin.
        spread, least_spread: variance of y where it does not hold, over that of the anchors' y around, and its least.
        window: standard deviation of the Gaussian that weighs the anchors around a node.
        few: weight of the prior variance of y in it, in certain anchors.
        most: largest log factor between the depth without the local correction and the one with it.
        square: largest y^2 of a held-out anchor in what is learnt of the growth: a factor of e^2.
        near, alone: leave-one-out residuals count in a square of ``2 near + 1`` cells, together with this many anchors
            of z^2 = 1.
        rounds, student: rounds of Student-t weights, and their degrees of freedom.
        nearer, farther: range of t, within which the weight of a weak anchor is evaluated.
        least_left: least share of 1 - w v, by which a residual is divided to leave its anchor out.
        clip, clipped: largest z^2 of an anchor in what is learnt, and the mean of min(z^2, clip) for normal z.
        weak: an anchor whose noise has this standard deviation counts half by area.
        evidence: an anchor is evidence if its noise has at most this standard deviation.
        discs, radius: of held-out anchors in a frame.
        step_u, step_v: the frame's number moves the discs along this sequence of low discrepancy.
        left: fewer anchors than this beside the discs: nothing is held out.
        memory: by how much a sum fades a frame, a half-life of 20 frames.
        alike: difference of log d at which a node counts half at a pixel.
        largest: no correction by more than this factor's logarithm: anchors off by more are not valid.
    """

    side: int = 28
    flat: float = 0.004
    edge: float = 2.0
    climb: float = 2.0
    smooth: float = 0.03
    kappa: float = 0.5
    hats: int = 3
    hat: float = 0.1**2
    prior: tuple[float, float, float, float] = (0.5, 0.45, 0.2, 0.2)
    drift: tuple[float, float, float, float] = (0.06, 0.06, 0.04, 0.03)
    inflation: float = 0.5
    common: float = 0.03**2
    limit: float = 2.0
    growth: float = 0.02
    claimed: float = 0.45
    far: float = 0.6
    wrong: float = 0.03
    other: float = 0.08
    spread: float = 1.6
    least_spread: float = 0.04
    window: float = 0.12
    few: float = 1.0
    most: float = 1.3862943611198906
    square: float = 4.0
    near: int = 2
    alone: float = 2.0
    rounds: int = 2
    student: float = 4.0
    nearer: float = -0.7
    farther: float = 2.0
    least_left: float = 0.05
    clip: float = 9.0
    clipped: float = 0.9950
    weak: float = 0.2
    evidence: float = 0.3
    discs: int = 3
    radius: float = 5 / 28
    step_u: float = 0.7548776662466927
    step_v: float = 0.5698402909980532
    left: int = 5
    memory: float = 0.5 ** (1 / 20)
    alike: float = 0.1
    largest: float = 4.605170185988092


MODEL = Model()
GLOBALS = 4
FEATURES = GLOBALS + MODEL.hats**2
