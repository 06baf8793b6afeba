"""Trained checkpoints: saving and loading, errors that name a bad file, and ``ufmstar run``."""

from __future__ import annotations

import copy
import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from layouts import truncate, write_generic
from runs import read_summary
from safetensors.torch import load_file, save_file
from tiny_suite import SPECS, make_networks, spec_of
from torch import nn

from ufmstar_torch import UncertainDepth, cli
from ufmstar_torch.eval.run.writers import read_frame
from ufmstar_torch.frames.prediction import combine
from ufmstar_torch.models import (
    BatchEnsemble,
    CheckpointError,
    Ensemble,
    LazyMember,
    MonteCarloDropout,
    load_network,
    load_trained,
    read_info,
    save_trained,
    set_sampling,
)
from ufmstar_torch.models.inference import Inference
from ufmstar_torch.models.trained import load_for_training


@pytest.fixture(scope="module")
def image():
    return torch.rand(1, 3, 32, 64, generator=torch.Generator().manual_seed(1))


def members_of(networks):
    return [m for n in networks for m in (n.all_members() if isinstance(n, BatchEnsemble) else [n])]


def ready(network):
    """The network in the form used by a run."""
    return Inference().ready(network, Path("net.safetensors"), torch.device("cpu"))


def predict(network, image):
    """Depth and variance, without dropout."""
    if isinstance(network, LazyMember):
        network = network.network()
    if isinstance(network, MonteCarloDropout):
        set_sampling(network, False)
    with torch.no_grad():
        out = network(image)
    return torch.stack([out.depth, *([] if out.variance is None else [out.variance])])


@pytest.mark.parametrize(
    ("method", "lazy"), [*((method, False) for method in SPECS), ("aleatoric", True), ("batch_ensemble", True)]
)
def test_what_was_saved_is_loaded_bit_for_bit(tmp_path, image, method, lazy):
    spec = spec_of(method)
    networks = make_networks(spec)
    save_trained(tmp_path / "n.safetensors", networks, spec, info={"command": "ufmstar train", "nll": 0.25})
    loaded = load_trained(tmp_path / "n.safetensors", lazy=lazy)
    expected = members_of(networks)
    assert len(loaded) == len(expected) == (6 if method == "batch_ensemble" else 2)
    for restored, original in zip(loaded, expected, strict=True):
        assert restored.preprocess == spec.input()
        assert not any(m.training for m in restored.modules())
        assert torch.equal(predict(restored, image), predict(original, image))
    stored = read_info(tmp_path / "n.safetensors")
    assert (stored.spec, stored.networks, stored.members) == (spec, 2, len(expected))
    assert stored.info == {"command": "ufmstar train", "nll": 0.25}


def test_training_goes_on_from_a_file(tmp_path):
    spec = spec_of("batch_ensemble")
    networks = make_networks(spec)
    save_trained(tmp_path / "n.safetensors", networks, spec)
    again = load_for_training(tmp_path / "n.safetensors")
    assert [type(network) for network in again] == [BatchEnsemble, BatchEnsemble]
    assert all(m.training for network in again for m in network.modules())
    for restored, original in zip(again, networks, strict=True):
        state = original.state_dict()
        assert all(torch.equal(value, state[key]) for key, value in restored.state_dict().items())


def test_lazy_members_read_their_own_weights_only(tmp_path, image):
    networks = make_networks(spec_of(), 3)
    file = tmp_path / "n.safetensors"
    save_trained(file, networks, spec_of())
    loaded = load_trained(file, lazy=True)
    assert not any(member.loaded for member in loaded)
    assert torch.equal(predict(loaded[1], image), predict(networks[1], image))
    assert [member.loaded for member in loaded] == [False, True, False]
    file.unlink()
    loaded[1](image)
    with pytest.raises(CheckpointError, match=r"n\.safetensors, member 2 cannot be loaded: no file"):
        loaded[2](image)


@pytest.mark.parametrize("offload", [False, True])
def test_lazy_members_of_a_batch_ensemble_share_their_weights(tmp_path, image, offload):
    spec = spec_of("batch_ensemble")
    networks = make_networks(spec)
    save_trained(tmp_path / "n.safetensors", networks, spec)
    for loaded in (lazies := load_trained(tmp_path / "n.safetensors", lazy=True, offload=offload), None):
        loaded = loaded or list(copy.deepcopy(nn.ModuleList(lazies)))
        for restored, original in zip(loaded, members_of(networks), strict=True):
            assert torch.equal(predict(restored, image), predict(original, image))
        ensembles = [member.network().ensemble for member in loaded]
        assert [e is ensembles[0] for e in ensembles] == [True] * 3 + [False] * 3


@pytest.mark.parametrize("method", ["mc_dropout", "batch_ensemble"])
def test_half_precision_is_half_the_file_and_nearly_the_network(tmp_path, image, method):
    spec = spec_of(method)
    networks = make_networks(spec)
    save_trained(tmp_path / "full.safetensors", networks, spec)
    save_trained(tmp_path / "half.safetensors", networks, spec, half=True)
    sizes = [(tmp_path / name).stat().st_size for name in ("full.safetensors", "half.safetensors")]
    header = struct.unpack("<Q", (tmp_path / "half.safetensors").read_bytes()[:8])[0]
    assert sizes[1] - header < 0.53 * (sizes[0] - header)
    full, half = (load_trained(tmp_path / name) for name in ("full.safetensors", "half.safetensors"))
    for one, other in zip(full, half, strict=True):
        for a, b in zip(one.state_dict().values(), other.state_dict().values(), strict=True):
            assert a.dtype == b.dtype
            # 2^-11 relative, or half the spacing of subnormal numbers.
            torch.testing.assert_close(b, a, rtol=2**-11, atol=2**-25)
        torch.testing.assert_close(predict(other, image), predict(one, image), rtol=0.02, atol=0.02)


def test_statistics_that_half_precision_cannot_hold_stay(tmp_path):
    (network,) = make_networks(spec_of(), 1)
    norms = [m for m in network.modules() if isinstance(m, nn.BatchNorm2d)]
    with torch.no_grad():
        norms[0].running_var[0] = 1e5  # would be infinite
        norms[1].running_mean[0] = -7e4
        norms[2].running_var[0] = 1e-6  # would keep 4 bits
        norms[3].weight[0] = 1e-9  # may become 0: no division by it
    save_trained(tmp_path / "n.safetensors", network, spec_of(), half=True)
    (restored,) = load_trained(tmp_path / "n.safetensors")
    again = [m for m in restored.modules() if isinstance(m, nn.BatchNorm2d)]
    assert torch.equal(again[0].running_var, norms[0].running_var)
    assert torch.equal(again[1].running_mean, norms[1].running_mean)
    assert torch.equal(again[2].running_var, norms[2].running_var)
    assert again[3].weight[0] == 0
    stored = load_file(tmp_path / "n.safetensors")
    float32_keys = [key for key, value in stored.items() if value.dtype == torch.float32]
    assert len(float32_keys) == 3
    assert {value.dtype for value in stored.values()} == {torch.float16, torch.float32, torch.int64}
    assert {value.dtype for value in restored.state_dict().values()} == {torch.float32, torch.int64}


def test_networks_that_do_not_fit_their_spec(tmp_path):
    networks = make_networks(spec_of())
    file = tmp_path / "n.safetensors"
    for wrong in (replace(spec_of(), method="evidential"), replace(spec_of(), widths=0.2)):
        with pytest.raises(ValueError, match=r"network 0 \(UncertaintyNetwork\) does not match its spec"):
            save_trained(file, networks, wrong)
    with pytest.raises(ValueError, match="at least one network, got n"):
        save_trained(file, [], spec_of())
    with pytest.raises(ValueError, match=r"need a file \.safetensors"):
        save_trained(tmp_path / "n.pt", networks, spec_of())
    with pytest.raises(TypeError, match="JSON serializable"):
        save_trained(file, networks, spec_of(), info={"what": object()})
    with torch.no_grad():
        networks[1].head.weight[0, 0, 0, 0] = torch.nan
    with pytest.raises(ValueError, match=r"member\.1\.head\.weight has NaN"):
        save_trained(file, networks, spec_of())
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "bad.safetensors"
    save_trained(path, make_networks(spec_of()), spec_of(), info={"a": 1})
    return path


def rewritten(path, change):
    """Rewrite the file after ``change`` has edited its tensors and metadata."""
    from safetensors import safe_open

    with safe_open(path, framework="pt") as opened:
        metadata = json.loads(opened.metadata()["metadata"])
    tensors = {key: value.clone() for key, value in load_file(path).items()}
    change(tensors, metadata)
    save_file(tensors, path, metadata={"metadata": json.dumps(metadata)})


METADATA = {
    "another format": (lambda m: m.update(format="something"), "no trained networks of this package"),
    "newer": (lambda m: m.update(version=2), "version 2, written by a newer release .* update it"),
    "no version": (lambda m: m.pop("version"), "version None, which does not exist"),
    "spec with an unknown key": (lambda m: m["spec"].update(depth=3), r"spec .* NetworkSpec has no \['depth'\]"),
    "impossible spec": (lambda m: m["spec"].update(size=[33, 64]), "spec that cannot be built: .*multiples of 32"),
    "spec of another kind": (lambda m: m.update(spec=7), "spec that cannot be built"),
    "no networks": (lambda m: m.update(networks=0), "damaged metadata"),
    "no info": (lambda m: m.pop("info"), "damaged metadata"),
}


@pytest.mark.parametrize("name", METADATA)
def test_metadata_that_cannot_be_used(file, name):
    change, message = METADATA[name]
    rewritten(file, lambda tensors, metadata: change(metadata))
    for load in (load_trained, read_info, lambda path: load_trained(path, lazy=True)):
        with pytest.raises(CheckpointError, match=rf"bad\.safetensors .*{message}"):
            load(file)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.999, None])
def test_a_file_that_is_cut_off_or_missing(file, share):
    kind, message = CheckpointError, r"bad\.safetensors is not a readable safetensors file"
    if share is None:
        file.unlink()
        kind, message = FileNotFoundError, r"bad\.safetensors"
    else:
        truncate(file, share)
    for load in (load_trained, read_info, lambda path: load_trained(path, lazy=True)):
        with pytest.raises(kind, match=message):
            load(file)


def test_damaged_weights_name_file_and_member(file, image):
    rewritten(file, lambda tensors, metadata: tensors.pop("member.1.head.bias"))
    message = r"bad\.safetensors, member 1, does not fit .*1 missing: head.bias"
    with pytest.raises(CheckpointError, match=message):
        load_trained(file)
    loaded = load_trained(file, lazy=True)
    loaded[0](image)
    with pytest.raises(CheckpointError, match=message):
        loaded[1](image)


def test_a_file_as_one_network(tmp_path, image):
    networks = make_networks(spec_of())
    save_trained(tmp_path / "two.safetensors", networks, spec_of())
    save_trained(tmp_path / "one.safetensors", networks[0], spec_of())
    ensemble = load_network("trained", tmp_path / "two.safetensors")
    assert isinstance(ensemble, Ensemble)
    expected = combine([network(image) for network in networks])
    assert torch.equal(ensemble(image).depth, expected.depth)
    assert torch.equal(ensemble(image).epistemic_variance, expected.epistemic_variance)
    assert torch.equal(
        predict(load_network("trained", tmp_path / "one.safetensors"), image), predict(networks[0], image)
    )


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A generic sequence of 4 frames, 48x64. Tests must not change it."""
    return write_generic(tmp_path_factory.mktemp("scene"), frames=4)[0]


@pytest.fixture
def ufmstar(capfd, scene, tmp_path):
    """Run the scene's sequence into a folder: (exit code, stdout, stderr)."""

    def call(*words, out="out"):
        capfd.readouterr()
        quiet = ("--plain", "--no-video", "--no-sheet", "--out", tmp_path / out)
        code = cli.main([str(word) for word in ("run", scene, "--model", "trained", *words, *quiet)])
        captured = capfd.readouterr()
        return code, captured.out, captured.err

    return call


def depths(out):
    return np.stack(
        [read_frame(path)["depth"] for path in sorted((out / "frames").iterdir(), key=lambda p: int(p.stem))]
    )


def by_hand(scene, members, mode="alternate"):
    """The depths of a run, computed by hand."""
    from ufmstar_torch.eval.sequences import open_sequence

    pipeline = UncertainDepth(members, mode=mode, posterior=False, preprocess=members[0].preprocess)
    depth = []
    for frame in open_sequence(scene):
        image = torch.from_numpy(frame.image).permute(2, 0, 1)[None]
        pose, K = torch.from_numpy(frame.T_world_cam)[None], torch.from_numpy(frame.intrinsics)[None]
        depth.append(pipeline(image, pose, K).depth[0].numpy())
    return np.stack(depth)


@pytest.mark.parametrize(("mode", "method"), [("alternate", "batch_ensemble"), ("full", "aleatoric")])
def test_a_run_with_all_members_of_two_files(ufmstar, scene, tmp_path, mode, method):
    spec = spec_of(method)
    networks = make_networks(spec, 3)
    save_trained(tmp_path / "a.safetensors", networks[:2], spec)
    save_trained(tmp_path / "b.safetensors", networks[2], spec)
    files = (tmp_path / "a.safetensors", tmp_path / "b.safetensors")
    code, out, err = ufmstar("--weights", *files, "--mode", mode)
    assert code == 0, err
    assert "finished: 4 of 4 frames" in out
    np.testing.assert_array_equal(
        depths(tmp_path / "out"), by_hand(scene, [ready(m) for m in members_of(networks)], mode)
    )
    source = read_summary(tmp_path / "out")["source"]
    assert [file["name"] for file in source["files"]] == ["a.safetensors", "b.safetensors"]
    assert (source["mode"], source["samples"]) == (mode, None)


MISTAKES = {
    "full with one member": (("--mode", "full"), "needs several members"),
    "samples of an ensemble": (("--mode", "full", "--samples", "3"), "needs several members"),
    "samples in turn": (("--samples", "3"), "goes with --mode full"),
    "one sample": (("--mode", "full", "--samples", "1"), "at least 2"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_reported_in_one_line(ufmstar, tmp_path, name):
    words, message = MISTAKES[name]
    weights = tmp_path / "a.safetensors"
    save_trained(weights, make_networks(spec_of(), 1), spec_of())
    code, _, err = ufmstar("--weights", weights, *words)
    assert (code, err.count("\n")) == (2, 1)
    assert message in err
    assert not (tmp_path / "out").exists()
