"""Heads on a user's networks: modules that return depth or features, and tiny models of transformers."""

from __future__ import annotations

import json
import re

import pytest
import torch
from depth_anything_files import write_depth_anything, write_other
from torch import nn
from torch.nn.functional import interpolate
from trainings import tiny_job

from ufmstar_torch import cli
from ufmstar_torch.eval.engine.load import NetworkChoice
from ufmstar_torch.models import (
    AleatoricHead,
    MonteCarloDropout,
    Preprocess,
    load_network,
    load_trained,
    read_info,
    wrap_network,
)
from ufmstar_torch.train import FitSettings, own_job, train_module
from ufmstar_torch.train.member import new_network

SIZE = (32, 32)
QUIET = {"tensorboard": False, "progress": False, "accelerator": "cpu"}
INPUT = Preprocess(size=SIZE)
SEED = 5  # for a tiny relative network whose output decreases with depth


class Own(nn.Module):
    """Depth from a feature map of four channels at half the resolution."""

    def __init__(self, returns: str = "depth") -> None:
        super().__init__()
        torch.manual_seed(3)
        self.encoder = nn.Sequential(nn.Conv2d(3, 4, 3, stride=2, padding=1), nn.BatchNorm2d(4), nn.ReLU())
        self.decoder = nn.Sequential(nn.Conv2d(4, 4, 3, padding=1), nn.ReLU())
        self.last, self.returns = nn.Conv2d(4, 1, 3, padding=1), returns

    def forward(self, image):
        features = self.decoder(self.encoder(image))
        return features if self.returns == "features" else 2 + self.last(features).tanh()


def data_of(frames):
    return tiny_job(frames, frames, augment=False).data


def train(backbone, head, frames, out, **options):
    how = {"max_steps": 2, "batch_size": 4, "settings": QUIET, "preprocess": INPUT}
    return train_module(backbone, head, data_of(frames), out, **{**how, **options})


def image(seed=0):
    return torch.rand(2, 3, *SIZE, generator=torch.Generator().manual_seed(seed))


def test_a_frozen_network_keeps_its_depth_and_gets_a_variance(frames, tmp_path):
    network = Own().eval()
    before = {key: value.clone() for key, value in network.state_dict().items()}
    trained = train(network, "aleatoric", frames, tmp_path, max_steps=12)
    prediction = trained(image())
    torch.testing.assert_close(prediction.depth, interpolate(network(image()), SIZE, mode="bilinear")[:, 0])
    assert prediction.aleatoric_variance.min() > 0
    assert prediction.aleatoric_variance.std() > 0
    assert all(torch.equal(value, before[key]) for key, value in network.state_dict().items())
    assert all(torch.equal(value, before[key]) for key, value in trained.backbone.network.state_dict().items())
    loaded = load_network("trained", tmp_path / "trained.safetensors", backbone=Own())
    assert torch.equal(loaded(image()).variance, prediction.variance)
    words = r"Own is a network of your own, which must be built in Python.*backbone=NETWORK"
    with pytest.raises(ValueError, match=words):
        load_trained(tmp_path / "trained.safetensors")


@pytest.mark.parametrize(
    ("head", "members", "fine_tune"),
    [
        ("evidential", None, False), ("evidential", None, True), ("mc-dropout", None, False), ("ensemble", 2, True),
        ("batch-ensemble", 2, False),
    ],
)  # fmt: skip
def test_every_head_on_a_module(frames, tmp_path, head, members, fine_tune):
    trained = train(Own(), head, frames, tmp_path, fine_tune=fine_tune, members=members)
    loaded = load_trained(tmp_path / "trained.safetensors", backbone=Own())
    assert len(loaded) == (members or 1)
    assert isinstance(loaded[0], MonteCarloDropout) == (head == "mc-dropout")
    assert trained(image()).variance.isfinite().all()
    assert read_info(tmp_path / "trained.safetensors").spec.module.part == "last"
    if head in ("evidential", "ensemble"):
        start, state = Own().state_dict(), loaded[0].backbone.network.state_dict()
        for key in ("last.weight", "encoder.1.running_mean"):
            assert torch.equal(state[key], start[key]) != fine_tune, key


def test_a_training_goes_on_and_starts_another(frames, tmp_path):
    """The same training again changes nothing. Its weights can start an ensemble and a network with another
    head."""
    train(Own(), "aleatoric", frames, tmp_path / "a")
    first = (tmp_path / "a" / "trained.safetensors").read_bytes()
    train(Own(), "aleatoric", frames, tmp_path / "a")
    assert len((tmp_path / "a" / "trained.safetensors").read_bytes()) == len(first)
    start = {"settings": {**QUIET, "init": tmp_path / "a" / "trained.safetensors"}, "max_steps": 1}
    trained = load_network("trained", tmp_path / "a" / "trained.safetensors", backbone=Own())
    members = train(Own(), "ensemble", frames, tmp_path / "b", members=2, learning_rate=1e-9, **start)
    torch.testing.assert_close(members(image()).aleatoric_variance, trained(image()).variance, rtol=1e-3, atol=1e-5)
    assert train(Own(), "evidential", frames, tmp_path / "c", **start)(image()).epistemic_variance is not None


def test_members_of_a_frozen_module_learn_their_factors(frames, tmp_path):
    job = own_job(Own(), "batch-ensemble", data_of(frames), FitSettings(out=tmp_path), preprocess=INPUT)
    named = dict(new_network(job, 0).named_parameters())
    backbone = {name: p for name, p in named.items() if ".backbone.network." in name}
    assert all(p.requires_grad == (name.rpartition(".")[2] in "rs") for name, p in backbone.items())
    assert all(p.requires_grad for name, p in named.items() if name.startswith("network.head"))


def test_a_module_of_features_learns_its_depth(frames, tmp_path):
    trained = train(Own("features"), "aleatoric", frames, tmp_path)
    assert trained(image()).depth.shape == (2, *SIZE)
    assert read_info(tmp_path / "trained.safetensors").spec.module.part is None


def test_declared_outputs_and_other_parts(frames, tmp_path):
    """``wrap_network`` declares a module's outputs; the head reads the input of the named part."""

    class Two(Own):
        def forward(self, image):
            return {"depth": 1000 * interpolate(super().forward(image), scale_factor=2), "other": image}

    wrapped = wrap_network(Two(), output="depth", scale=0.001, preprocess=INPUT)
    trained = train(wrapped, AleatoricHead, frames, tmp_path, preprocess=None, features="network.decoder")
    assert read_info(tmp_path / "trained.safetensors").spec.module.channels == 4
    assert 1 < trained(image()).depth.mean() < 3


@pytest.mark.parametrize("kind", ["metric", "relative"])
def test_a_checkpoint_from_the_command_line(frames, tmp_path, kind, capsys):
    """The trained file is complete: the checkpoint is not needed any more. A relative checkpoint is aligned to the
    training depths."""
    folder = write_depth_anything(tmp_path / "checkpoint", kind, seed=SEED)
    (tmp_path / "spec.json").write_text('{"size": [70, 84], "keep_aspect": false}')
    words = ["--backbone", folder, "--head", "aleatoric", "--spec", tmp_path / "spec.json", "--data", "sequences"]
    words += [
        "--root",
        frames,
        "--set",
        "data.part=0:12",
        "--set",
        "data.validation_part=12:16",
        "--max-steps",
        "2",
        "--batch-size",
        "4",
    ]
    words += ["--no-progress", "--no-tensorboard", "--accelerator", "cpu", "--out", tmp_path / "out"]
    assert cli.main(["train", *map(str, words)]) == 0
    assert "val_nll" in capsys.readouterr().out
    folder.rename(tmp_path / "gone")
    network = load_network("trained", tmp_path / "out" / "trained.safetensors")
    x = torch.rand(1, 3, 70, 84, generator=torch.Generator().manual_seed(0))
    prediction = network(x)
    assert prediction.variance.isfinite().all()
    choice = NetworkChoice("", "trained", (str(tmp_path / "out" / "trained.safetensors"),))
    assert choice.load(torch.device("cpu")).label == "checkpoint"
    declared = network.backbone.network
    if kind == "metric":
        expected = load_network("huggingface", tmp_path / "gone", spec={"size": [70, 84], "keep_aspect": False})
        torch.testing.assert_close(prediction.depth, expected(x).depth)
    else:
        assert declared.alignment.kind == "inverse"
        assert 0.5 < prediction.depth[prediction.depth > 0].median() < 5


def test_a_checkpoint_without_its_image_processor(frames, tmp_path, capsys):
    """The error names the file and the declaration that stands in."""
    (write_other(tmp_path / "dpt", "dpt") / "preprocessor_config.json").unlink()
    (tmp_path / "spec.json").write_text('{"kind": "metric", "size": [64, 64]}')
    words = [
        "train",
        "--backbone",
        tmp_path / "dpt",
        "--data",
        "sequences",
        "--root",
        frames,
        "--out",
        tmp_path / "out",
    ]
    assert cli.main([*map(str, words), "--spec", str(tmp_path / "spec.json")]) == 2
    error = capsys.readouterr().err
    assert "dpt has no preprocessor_config.json" in error
    spec = {"kind": "metric", **json.loads(re.search(r"spec: (\{.*\}\}),", error)[1].replace("...", "0.5, 0.5, 0.5"))}
    spec["preprocess"]["size"] = [64, 64]
    (tmp_path / "spec.json").write_text(json.dumps(spec))
    network = load_network("huggingface", tmp_path / "dpt", spec=tmp_path / "spec.json")
    assert network.preprocess == Preprocess(size=(64, 64), mean=(0.5,) * 3, std=(0.5,) * 3)


@pytest.mark.parametrize("head", ["mc-dropout", "batch-ensemble"])
def test_members_of_a_checkpoint(frames, tmp_path, head):
    folder, spec = write_other(tmp_path / "dpt", "dpt"), {"kind": "metric"}
    trained = train(folder, head, frames, tmp_path / "out", preprocess=None, spec=spec, fine_tune=True)
    assert trained(torch.rand(1, 3, 64, 64)).variance.isfinite().all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"head": "ensembles"}, "head must be one of depth-only, aleatoric"),
        ({"head": AleatoricHead(4)}, "head must be text or a class derived from UncertaintyHead, got AleatoricHead"),
        ({"head": "depth-only"}, "leaves nothing to train on a frozen network"),
        ({"features": "neck"}, "the network has no part 'neck'; it has .'encoder', 'decoder', 'last'."),
        ({"epoch": 3}, "train_module has no .'epoch'."),
        ({"backbone": nn.Flatten()}, "must be"),
    ],
)
def test_impossible_arguments(frames, tmp_path, change, message):
    values = {"backbone": Own(), "head": "aleatoric", **change}
    with pytest.raises(TypeError if "got AleatoricHead" in message else ValueError, match=message):
        train(values.pop("backbone"), values.pop("head"), frames, tmp_path, **values)
