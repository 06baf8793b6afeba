"""What the words of a report mean, a sentence or two each."""

from __future__ import annotations

# Term, meaning, and whether less is better.
GLOSSARY: tuple[tuple[str, str], ...] = (
    ("δ₁ ↑", "Share of pixels whose predicted depth lies within 25 % of the ground truth."),
    (
        "δ₁ (ratio) ↑",
        "The depth literature's test: share of pixels with max(d/g, g/d) < 1.25, d predicted and g true.",
    ),
    ("AbsRel ↓", "Mean of |d - g| / g."),
    ("RMSE ↓", "Root of the mean squared error of the depth, in metres."),
    (
        "NLL ↓",
        "Mean of (g - d)² / (2V) + ½ ln(2πV): how surprising the truth is, given prediction and variance. Better depth "
        "alone lowers it too, so it is for rows with similar δ₁.",
    ),
    (
        "ECE_δ ↓",
        "Pixels are grouped by the probability that the method gives to its depth being within 25 %; the error is how "
        "far, on average, that probability is from how often it holds.",
    ),
    (
        "ECE_q ↓",
        "Below the q-quantile of its predicted distribution the true depth should lie with frequency q; the error is "
        "how far it is off, on average over q.",
    ),
    (
        "AUSE ↓, AURG ↑",
        "Leave out the most uncertain pixels step by step: AUSE is the area between the error that remains and the one "
        "that the best order would leave, AURG the area gained on a random order; both in metres. They judge the order "
        "of the uncertainties, not their size.",
    ),
    ("Spearman ↑", "Rank correlation of variance and squared error: 1 is the right order, 0 is none."),
    ("entropy", "½ ln(2πeV) in nats: how uncertain a method is, whether or not it should be."),
    (
        "overconfidence",
        "How far the probabilities of ECE_δ lie above the frequencies on average; negative is underconfident.",
    ),
    ("σ, V", "Standard deviation in metres and variance in m²; V = A + E + M."),
    (
        "A, E, M",
        "The network's own (aleatoric) variance, the spread of its members or samples (epistemic), and the "
        "disagreement between the views, which UfM and UfM* add.",
    ),
    ("m", "Disagreement that is stored with a Gaussian, in m²; its root √m is in metres."),
    (
        "state",
        "What a method keeps in memory between two images: points (UfM) or Gaussians (UfM*), without the map for "
        "smoothing.",
    ),
    (
        "± and 95 %",
        "Half-width of the 95 % confidence interval of the mean over sequences, each counting the same. Two rows are "
        "compared by their differences on the same sequences, which is sharper than comparing two intervals.",
    ),
    (
        "beyond chance",
        "The 95 % interval of that paired difference leaves out 0. Of many comparisons one in twenty does so by "
        "chance.",
    ),
    (
        "-100K, -300K",
        "UfM with its cloud pruned to so many points. Without a number it keeps all of them.",
    ),
    (
        "Full, MCD, fixed-param",
        "All members or samples on every image, not one in turn; MC-Dropout; thresholds of the segmentation in pixels "
        "as at 224 x 224, whatever the size.",
    ),
)
