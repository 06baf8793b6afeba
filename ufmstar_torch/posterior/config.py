"""The constants of the posterior, shared by all tiers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ufmstar_torch.runtime.checked import Checked, number


@dataclass(frozen=True)
class PosteriorConfig(Checked):
    """Settings and constants of the posterior's model (``posterior.update``).

    Lengths are in image widths; y = log(g/d).

    ``python docs/measure_posterior.py`` prints the results on rendered tours with each constant varied
    (docs/results/posterior.md).

    Attributes:
        half_life: age at which an anchor's contribution to the learnt values counts half
        discs: number of discs whose anchors are held out in each frame
    """

    half_life: float = number(20.0, "ln 2/ln(1/gamma)", "frames", 0.0, open_low=True)
    discs: int = number(3, "", "1", 0, 16)

    # Constants of the model, chosen on rendered tours; docs/measure_posterior.py prints the effect of each.
    # v_0 [1]: variance of f's difference between neighbouring nodes of equal predicted depth
    link_variance: ClassVar[float] = 0.0015
    # v_1 [1]: additional variance per squared difference of log d between the two nodes, times ``jump``
    edge_variance: ClassVar[float] = 6.0
    # c_j [1]: factor on that difference: networks smooth depth edges
    jump: ClassVar[float] = 1.67
    # kappa [1]: precision of f at a node
    precision: ClassVar[float] = 0.5
    # sigma_d, sigma_t [1]: standard deviations of b's slopes in log d, and in u and v, without anchors
    slope_sigma: ClassVar[float] = 0.12
    tilt_sigma: ClassVar[float] = 0.2
    # rho [1/frame]: share of b's slopes that a frame forgets
    reversion: ClassVar[float] = 0.2
    # n_1 [frames]: weight of slopes of 0 in the mean slopes
    slope_weight: ClassVar[float] = 3.0
    # l_1 [width]: distance from the evidence at which the slopes are half the frame's and half the mean
    slope_reach: ClassVar[float] = 0.5
    # p_1 [1]: probability that b's constant lies beyond its prior before the first anchor
    misscaled: ClassVar[float] = 0.1
    # nu [1]: of the Student-t distributions of an anchor's residual and of f's difference across a link
    degrees_of_freedom: ClassVar[float] = 2.0
    # sigma_1^2 [1]: each of a frame's N anchors has the additional variance alone/N of y
    alone: ClassVar[float] = 1.0
    # sigma_0 [1]: initial value of the standard deviation of y between neighbouring pixels
    roughness: ClassVar[float] = 0.05
    # g [1/width]: initial value of the variance of y per image width of distance from evidence
    unseen: ClassVar[float] = 0.06
    # n_0 [anchors]: weight of the initial values, in anchors or pairs of neighbouring anchors
    prior_weight: ClassVar[float] = 20.0
    # c [1]: upper limit of an anchor's z^2 in the estimates of roughness, noise and local scale
    clip: ClassVar[float] = 9.0
    # sigma_w [1]: noise standard deviation at which an anchor counts half; noisier anchors are no evidence
    weak_sigma: ClassVar[float] = 0.25
    # l [width]: distance from the evidence beyond which a node counts as without evidence
    reach: ClassVar[float] = 1.0
    # r [width]: radius of a disc; standard deviation of the Gaussian window for the variance of y around a
    # node; distance from the evidence beyond which local errors do not change ``wrong``
    radius: ClassVar[float] = 0.15
    # p_0 [1]: initial value of the probability that the local correction does not hold
    wrong: ClassVar[float] = 0.015
    # v_3 [1]: factor on ``unseen`` where the local correction does not hold
    elsewhere: ClassVar[float] = 12.0
    # s_0 [1]: initial value of the scale of y over surfaces, beyond the shared scale
    between: ClassVar[float] = 0.2
    # r_1 [width]: standard deviation of the Gaussian window of the local scale
    near: ClassVar[float] = 0.05
    # v_2 [1]: upper limit of the variance of y
    widest: ClassVar[float] = 2.0
    # F [1]: factor between depth and truth beyond which errors do not count in a variance
    farthest: ClassVar[float] = 6.0
    # a_0 to a_3 [1]: factors on the parts of the variance at a pixel, as pixels do not lie on the texture on which
    # anchors do
    pixel_field: ClassVar[float] = 0.17
    pixel_roughness: ClassVar[float] = 21.0
    pixel_unseen: ClassVar[float] = 0.55
    pixel_steepness: ClassVar[float] = 2.3
    # delta [1]: difference of log d between a node and a pixel at which the node's weight is halved
    edge_contrast: ClassVar[float] = 0.1
    # sigma_b [1]: standard deviation of b's constant before the first anchor
    prior_sigma: ClassVar[float] = 0.5
    # tau [1/frame^.5]: standard deviation of the change of b's constant from frame to frame
    drift: ClassVar[float] = 0.05
    # c_1 [1]: variance of the scale in a view that shares nothing with the evidence, over ``between``
    places: ClassVar[float] = 3.0
    # c_2 [1]: power of the mean distance from evidence by which a frame with anchors confirms the scale of its view
    confirmed: ClassVar[float] = 4.0

    @property
    def prior_variance(self) -> tuple[float, float, float, float]:
        """The variances of the coefficients b before the first anchor."""
        return (self.prior_sigma**2, self.slope_sigma**2, self.tilt_sigma**2, self.tilt_sigma**2)
