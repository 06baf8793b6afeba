"""The constants of the posterior, shared by all tiers."""

from __future__ import annotations

from dataclasses import dataclass

from ufmstar_torch.runtime.checked import Checked, number


@dataclass(frozen=True)
class PosteriorConfig(Checked):
    """Constants of the posterior's model (``posterior.update``). Lengths are in image widths; y = log(g/d).

    ``python docs/measure_posterior.py`` prints the results on rendered tours with each constant varied
    (docs/results/posterior.md).

    Attributes:
        link_variance: variance of f's difference between neighbouring nodes of equal predicted depth
        edge_variance: additional variance per squared difference of log d between the two nodes, times ``jump``
        jump: factor on that difference: networks smooth depth edges
        precision: precision of f at a node
        prior_sigma: standard deviation of b's constant before the first anchor
        tilt_sigma: standard deviation of b's slopes in log d, u and v without anchors
        drift: standard deviation of the change of b's constant from frame to frame
        reversion: share of b's slopes that a frame forgets
        misscaled: probability that b's constant lies beyond its prior before the first anchor
        degrees_of_freedom: of the Student-t distributions of an anchor's residual and of f's difference across a link
        alone: each of a frame's N anchors has the additional variance alone/N of y
        roughness: initial value of the standard deviation of y between neighbouring pixels
        unseen: initial value of the variance of y per image width of distance from evidence
        prior_weight: weight of the initial values, in anchors or pairs of neighbouring anchors
        half_life: age at which an anchor's contribution to the learnt values counts half
        clip: upper limit of an anchor's z^2 in the estimates of roughness, noise and local scale
        weak_sigma: noise standard deviation at which an anchor counts half; noisier anchors are no evidence
        reach: distance from the evidence beyond which a node counts as without evidence
        discs: number of discs whose anchors are held out in each frame
        radius: radius of a disc; standard deviation of the Gaussian window for the variance of y around a node;
            distance from the evidence beyond which local errors do not change ``wrong``
        wrong: initial value of the probability that the local correction does not hold
        elsewhere: factor on ``unseen`` where the local correction does not hold
        between: initial value of the scale of y over surfaces, beyond the shared scale
        near: standard deviation of the Gaussian window of the local scale
        widest: upper limit of the variance of y
        farthest: factor between depth and truth beyond which errors do not count in a variance
        pixel_field, pixel_roughness, pixel_unseen, pixel_steepness: factors on the parts of the variance at a pixel, as
            pixels do not lie on the texture on which anchors do
        edge_contrast: difference of log d between a node and a pixel at which the node's weight is halved
    """

    link_variance: float = number(0.0015, "v_0", "1", 0.0, open_low=True)
    edge_variance: float = number(6.0, "v_1", "1", 0.0, open_low=True)
    jump: float = number(1.67, "c_j", "1", 0.0, open_low=True)
    precision: float = number(0.5, "kappa", "1", 0.0, open_low=True)
    prior_sigma: float = number(0.5, "sigma_b", "1", 0.0, open_low=True)
    tilt_sigma: float = number(0.2, "sigma_t", "1", 0.0, open_low=True)
    drift: float = number(0.05, "tau", "1/frame^.5", 0.0)
    reversion: float = number(0.2, "rho", "1/frame", 0.0, 1.0)
    misscaled: float = number(0.1, "p_1", "1", 0.0, 0.5)
    degrees_of_freedom: float = number(2.0, "nu", "1", 0.0, open_low=True)
    alone: float = number(1.0, "sigma_1^2", "1", 0.0)
    roughness: float = number(0.05, "sigma_0", "1", 0.0, open_low=True)
    unseen: float = number(0.06, "g", "1/width", 0.0)
    prior_weight: float = number(20.0, "n_0", "anchors", 0.0, open_low=True)
    half_life: float = number(20.0, "ln 2/ln(1/gamma)", "frames", 0.0, open_low=True)
    clip: float = number(9.0, "c", "1", 0.0, open_low=True)
    weak_sigma: float = number(0.25, "sigma_w", "1", 0.0, open_low=True)
    reach: float = number(1.0, "l", "width", 0.0, open_low=True)
    discs: int = number(3, "", "1", 0, 16)
    radius: float = number(0.15, "r", "width", 0.0, open_low=True)
    wrong: float = number(0.015, "p_0", "1", 0.0, 0.5)
    elsewhere: float = number(12.0, "v_3", "1", 0.0)
    between: float = number(0.2, "s_0", "1", 0.0, open_low=True)
    near: float = number(0.05, "r_1", "width", 0.0, open_low=True)
    widest: float = number(2.0, "v_2", "1", 0.0, 4.0, open_low=True)
    farthest: float = number(6.0, "F", "1", 1.0, 100.0, open_low=True)
    pixel_field: float = number(0.17, "a_0", "1", 0.0, open_low=True)
    pixel_roughness: float = number(21.0, "a_1", "1", 0.0, open_low=True)
    pixel_unseen: float = number(0.55, "a_2", "1", 0.0)
    pixel_steepness: float = number(2.3, "a_3", "1", 0.0)
    edge_contrast: float = number(0.1, "delta", "1", 0.0, open_low=True)

    @property
    def prior_variance(self) -> tuple[float, float, float, float]:
        """The variances of the coefficients b before the first anchor."""
        return (self.prior_sigma**2, *(self.tilt_sigma**2,) * 3)
