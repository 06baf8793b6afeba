"""The constants of the posterior, one place for all tiers."""

from __future__ import annotations

from dataclasses import dataclass

from ufmstar_torch.checked import Checked, number


@dataclass(frozen=True)
class PosteriorConfig(Checked):
    """The posterior's model (``posterior.update``). Lengths are in widths of the image, y = log(g/d).

    ``python docs/measure_posterior.py`` fits them: it prints what the table of rendered tours becomes with each of them
    changed (docs/results/posterior.md).

    Attributes:
        link_variance: variance of f's difference between neighbouring nodes of equal predicted depth
        edge_variance: what is added to it, over the square of their difference of log d
        precision: precision of f at a node
        prior_sigma: standard deviation of b's constant and of its slope in log d before the first anchor
        tilt_sigma: the same of its slopes in u and v
        drift: standard deviation of b's change from frame to frame
        degrees_of_freedom: of the Student-t distributions of an anchor about the others' prediction, and of a link
        alone: variance of y of an anchor without others; 1/N of it, of each among N
        roughness: standard deviation of y from one pixel to the next, before it is learnt
        unseen: variance of y a width of the image from evidence, before it is learnt
        prior_weight: anchors, or pairs of neighbouring ones, for which these values count
        half_life: age after which what an anchor taught counts half
        clip: largest z^2 of an anchor in what is learnt of roughness and noise
        weak_sigma: an anchor whose noise has this standard deviation counts half by area; a noisier one is no evidence
        reach: distance from the evidence from which on a node has none
        discs: discs of anchors that are held out in a frame
        radius: of a disc; standard deviation of the Gaussian that weighs the anchors around a node; distance from the
            evidence from which on the errors of anchors do not change the probability of another surface
        wrong: probability that the local correction does not hold, before it is learnt
        elsewhere: how many times as fast the variance of y grows with the distance from evidence if it does not hold
        near: standard deviation of the Gaussian that weighs the errors of anchors around a node
        widest: variance of y from which on the variance of the depth grows no more
        edge_contrast: difference of log d at which a node counts half at a pixel
    """

    link_variance: float = number(0.0015, "v_0", "1", 0.0, open_low=True)
    edge_variance: float = number(6.0, "v_1", "1", 0.0, open_low=True)
    precision: float = number(0.5, "kappa", "1", 0.0, open_low=True)
    prior_sigma: float = number(0.5, "sigma_b", "1", 0.0, open_low=True)
    tilt_sigma: float = number(0.2, "sigma_t", "1", 0.0, open_low=True)
    drift: float = number(0.05, "tau", "1/frame^.5", 0.0)
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
    near: float = number(0.05, "r_1", "width", 0.0, open_low=True)
    widest: float = number(2.0, "v_2", "1", 0.0, 4.0, open_low=True)
    edge_contrast: float = number(0.1, "delta", "1", 0.0, open_low=True)

    @property
    def prior_variance(self) -> tuple[float, float, float, float]:
        """The variances of the coefficients b before the first anchor."""
        return (self.prior_sigma**2, self.prior_sigma**2, self.tilt_sigma**2, self.tilt_sigma**2)
