"""Checks that networks predict the variances that their base needs, before the first frame."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ufmstar_torch.eval.engine.networks import stochastic
from ufmstar_torch.models.batch_ensemble import BatchEnsemble, BatchEnsembleMember
from ufmstar_torch.models.dropout import DecoderDropout, MonteCarloDropout, set_sampling
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.prediction import DepthPrediction, infer

_PROBE = (480, 640)  # (h, w) [px] of the grey image that the networks are tried on


def without_sampling(network: DepthNetwork) -> DepthNetwork:
    """The network itself where it came as MC-Dropout, no longer sampling."""
    if not isinstance(network, MonteCarloDropout):
        return network
    set_sampling(network.network, False)
    return network.network


def check_members(base: str, members: Sequence[DepthNetwork], device: torch.device) -> None:
    """Try the networks of a base. Raises ValueError: they do not deliver what it needs; the message names both.

    ============== =====================================================================
    ensemble       two members or more, each with an aleatoric variance
    mc_dropout     one network that samples by its decoder's dropout
    batch_ensemble the members of one BatchEnsemble, with an aleatoric variance
    evidential     one network, with an aleatoric and an epistemic variance
    aleatoric      one network, with an aleatoric variance and no epistemic one
    depth_only     one network; a variance is ignored
    ============== =====================================================================
    """
    shared = [member for member in members if isinstance(member, BatchEnsembleMember)]
    if base == "batch_ensemble":
        kinds = ", ".join(sorted({type(member).__name__ for member in members}))
        note = " (as one network; give the trained file itself)" if BatchEnsemble.__name__ in kinds.split(", ") else ""
        several = f"{len(members)} of the kind {kinds}{note}"
        _require(len(shared) == len(members) > 1, base, "a file with a BatchEnsemble", several)
        one = len({id(member.ensemble) for member in shared}) == 1
        _require(one, base, "one BatchEnsemble", "several of them")
    elif base == "ensemble":
        several = f"{len(members)} network" + ("s" if len(members) > 1 else "")
        _require(len(members) > 1, base, "two members or more", several)
        _require(
            not shared, base, "networks of their own", "the members of a BatchEnsemble (give it as batch_ensemble=)"
        )
    else:
        picked = "(FILE#0 is the first member of a file)"
        _require(len(members) == 1, base, f"one network {picked}", f"{len(members)} members")
    if base == "mc_dropout":
        samples = stochastic(members) and any(isinstance(m, DecoderDropout) and m.p > 0 for m in members[0].modules())
        _require(bool(samples), base, "a network trained as mc_dropout, which samples", "one that does not")
    if base in ("depth_only", "mc_dropout"):
        return
    height, width = _PROBE
    K = torch.tensor([[[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]]], dtype=torch.float64)
    for member in members:
        with torch.no_grad():
            grey = torch.full((1, 3, height, width), 128, dtype=torch.uint8, device=device)
            x, K_member = member.preprocess(grey, K)
            prediction: DepthPrediction = infer(member.to(device).eval(), x, K_member)
        has = prediction.aleatoric_variance is not None, prediction.epistemic_variance is not None
        got = {(True, True): "both variances", (True, False): "an aleatoric one", (False, True): "an epistemic one"}
        if base == "evidential":
            _require(all(has), base, "an aleatoric and an epistemic variance", got.get(has, "none"))
        else:
            _require(has[0], base, "an aleatoric variance", got.get(has, "none"))
            _require(base != "aleatoric" or not has[1], base, "an aleatoric variance alone", "an epistemic one as well")


def _require(fulfilled: bool, base: str, wanted: str, got: str) -> None:
    if not fulfilled:
        raise ValueError(f"{base} needs {wanted}, got {got}")
