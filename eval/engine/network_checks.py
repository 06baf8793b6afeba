"""Checks, before the first frame, that networks predict the variances that their base needs."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ufmstar_torch.eval.engine.networks import stochastic
from ufmstar_torch.frames.prediction import DepthPrediction, infer
from ufmstar_torch.models.batch_ensemble import BatchEnsembleMember
from ufmstar_torch.models.dropout import DecoderDropout, MonteCarloDropout, set_sampling
from ufmstar_torch.models.network import DepthNetwork

_PROBE = (480, 640)  # (h, w) [px] of the grey test image
_NEEDED = {
    "ensemble": "two networks or more (not batch_ensemble=), each with an aleatoric variance",
    "mc_dropout": "one network that samples, by its decoder's dropout",
    "batch_ensemble": "a file with one BatchEnsemble (as it was trained), with an aleatoric variance",
    "evidential": "one network (FILE#0 is the first of a file), with an aleatoric and an epistemic variance",
    "aleatoric": "one network (FILE#0 is the first of a file), with an aleatoric variance and no epistemic one",
    "depth_only": "one network (FILE#0 is the first of a file)",
}


def without_sampling(network: DepthNetwork) -> DepthNetwork:
    """The network; for MC-Dropout the wrapped network with sampling off."""
    if not isinstance(network, MonteCarloDropout):
        return network
    set_sampling(network.network, False)
    return network.network


def check_members(base: str, members: Sequence[DepthNetwork], device: torch.device) -> None:
    """Run the networks of a base on a test image. Raises ValueError: they are not what the base needs (``_NEEDED``)."""
    ensembles = [member.ensemble for member in members if isinstance(member, BatchEnsembleMember)]
    single_ensemble = len(ensembles) == len(members) > 1 and len({id(ensemble) for ensemble in ensembles}) == 1
    fitting = {"batch_ensemble": single_ensemble, "ensemble": len(members) > 1 and not ensembles}.get(
        base, len(members) == 1
    )
    kinds = ", ".join(sorted({type(member).__name__ for member in members}))
    got = f"{len(members)} of the kind {kinds}"
    if fitting and base == "mc_dropout":
        drawn = stochastic(members) and any(isinstance(m, DecoderDropout) and m.p > 0 for m in members[0].modules())
        fitting, got = bool(drawn), "one that does not sample"
    height, width = _PROBE
    K = torch.tensor([[[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]]], dtype=torch.float64)
    for member in members if fitting and base not in ("depth_only", "mc_dropout") else ():
        with torch.no_grad():
            grey = torch.full((1, 3, height, width), 128, dtype=torch.uint8, device=device)
            x, K_member = member.preprocess(grey, K)
            prediction: DepthPrediction = infer(member.to(device).eval(), x, K_member)
        aleatoric, epistemic = prediction.aleatoric_variance is not None, prediction.epistemic_variance is not None
        fitting &= aleatoric and {"evidential": epistemic, "aleatoric": not epistemic}.get(base, True)
        got = {(True, True): "both", (True, False): "an aleatoric one", (False, True): "an epistemic one"}.get(
            (aleatoric, epistemic), "none"
        )
    if not fitting:
        raise ValueError(f"{base} needs {_NEEDED[base]}, got {got}")
