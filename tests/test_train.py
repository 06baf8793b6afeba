"""Recipes, the training module's arithmetic, a training's files, and its command line."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from onnx_files import write_fastdepth
from shared_data import require_shared
from trainings import RECIPE, SPEC, logged, scenes, tiny_job, trained, with_network, write_frames

from ufmstar_torch.models import (
    CheckpointError,
    MonodepthResNet,
    NetworkSpec,
    build_network,
    load_trained,
    read_info,
    save_trained,
)
from ufmstar_torch.models.batch_layer import BatchLayer
from ufmstar_torch.train import DepthDataModule, NonFiniteLossError, Recipe, TrainingModule, starting_network
from ufmstar_torch.train.command import _WITHOUT, _fields_of
from ufmstar_torch.train.fit import fit
from ufmstar_torch.train.folder import WEIGHTS
from ufmstar_torch.train.member import new_network, read_checkpoint

ONE_STEP = replace(RECIPE, max_steps=1)


# ---- trainings ----


@pytest.mark.slow
def test_it_learns_depth_and_where_the_depth_is_noisy(tmp_path):
    """Twelve scenes, the red half of each with noise of .9 m, twice for training and once more for validation.

    Over ten seeds, the likelihood's gain was .45 nat at least (.51 in the median), the error of the depth .56 of the
    depth's deviation at most (.28), sigma's ratio 2.7 at least (4.1) and the fall of the loss .71 at least (.83); with
    ATEN_CPU_CAPABILITY=avx2 and default and ONEDNN_MAX_CPU_ISA=AVX2, three seeds each, nothing came nearer to a limit.
    """
    size = (64, 64)
    folders = [str(write_frames(tmp_path / f"walk{n}", 12, size, noise=0.9, seed=n)) for n in (1, 2, 3)]
    recipe = replace(with_network(RECIPE, size=size), epochs=20, average=0.0)
    job = tiny_job(folders[0], tmp_path / "out", recipe, augment=False)
    parts = {"part": "0:", "validation_part": "0:", "validation_paths": (folders[1],)}
    summary = fit(replace(job, data=replace(job.data, paths=(folders[0], folders[2]), **parts)))
    losses, last = logged(tmp_path / "out", "train_loss_epoch"), summary["mean"]
    assert len(losses) == 20
    assert len(logged(tmp_path / "out", "train_loss_step")) == summary["members"][0]["steps"] == 120
    assert losses[-1] < losses[0] - 0.3
    assert last["val_nll"] < last["val_nll_constant"] - 0.15
    assert last["val_nll"] == pytest.approx(logged(tmp_path / "out", "val_nll")[-1], rel=1e-5)
    (network,) = load_trained(tmp_path / "out" / WEIGHTS)
    images, depths, _, red = scenes(12, size, noisy=True)
    with torch.no_grad():
        prediction = network(torch.from_numpy(images).permute(0, 3, 1, 2) / 255)
    error, sigma = prediction.depth.numpy() - depths, prediction.variance.sqrt().numpy()
    assert np.sqrt((error[~red] ** 2).mean()) < 0.85 * depths[~red].std()
    assert np.median(sigma[red]) > 1.5 * np.median(sigma[~red])


@pytest.fixture(scope="module")
def pair(frames, tmp_path_factory):
    """Folder and summary of an ensemble of two, stored in half precision; the last of 4 steps is inside an epoch."""
    out = tmp_path_factory.mktemp("trained") / "out"
    job = tiny_job(frames, out, replace(RECIPE, members=2, max_steps=4, half=True))
    return out, fit(job, command=["ufmstar", "train"]), job


def test_what_a_training_leaves(pair):
    out, summary, _ = pair
    assert summary["stopped"] is None
    assert summary["command"] == ["ufmstar", "train"]
    assert torch.__version__.startswith(summary["versions"]["torch"])
    assert {"cpu", "cores", "threads", "gpus"} <= set(summary["hardware"])
    assert summary["seconds"] > 0
    stored = json.loads((out / "summary.json").read_text())
    assert stored["members"] == summary["members"]
    # Validated at the end, although no epoch ended there.
    assert [m["steps"] for m in summary["members"]] == [4, 4]
    assert all(len(logged(out, "val_rmse", member)) == 2 for member in (0, 1))


def test_the_file_of_all_members_predicts_as_the_members(pair):
    out, _, job = pair
    image = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(1))
    members = load_trained(out / WEIGHTS)
    assert read_info(out / WEIGHTS).info["recipe"]["members"] == 2
    for n, member in enumerate(members):
        alone = trained(job, n)
        torch.testing.assert_close(member(image).depth, alone(image).depth, atol=0.02, rtol=0.02)
    assert (members[0](image).depth - members[1](image).depth).abs().max() > 1e-3


def test_logs_for_tensorboard(frames, tmp_path):
    fit(tiny_job(frames, tmp_path / "out", replace(RECIPE, epochs=1), tensorboard=True))
    assert list((tmp_path / "out" / "tensorboard" / "member_0").glob("events.*"))


@pytest.mark.parametrize(
    "network",
    [
        {"method": "depth"},
        {"method": "evidential"},
        {"method": "mc_dropout", "dropout": 0.2},
        {"method": "batch_ensemble", "members": 2},
    ],
    ids=lambda network: network["method"],
)
def test_every_method_trains(frames, tmp_path, network):
    recipe = replace(with_network(RECIPE, **network), max_steps=3, batch_size=4)
    summary = fit(tiny_job(frames, tmp_path / "out", recipe))
    figures = summary["members"][0]["figures"]
    assert math.isfinite(figures["val_rmse"])
    assert ("val_nll" in figures) == (network["method"] != "depth")
    assert len(load_trained(tmp_path / "out" / WEIGHTS)) == network.get("members", 1)


def test_bfloat16_trains_and_its_loss_is_in_single_precision(frames, tmp_path):
    """Compares the first step's loss; later losses depend on the updated weights."""
    recipe = replace(ONE_STEP, average=0.0)
    losses = []
    for name, precision in (("full", "32-true"), ("mixed", "bf16-mixed")):
        fit(tiny_job(frames, tmp_path / name, recipe, precision=precision))
        losses += logged(tmp_path / name, "train_loss_step")
    assert losses[0] != losses[1]
    assert losses[0] == pytest.approx(losses[1], rel=0.05)


def test_the_factors_of_a_batch_ensemble_do_not_decay():
    recipe = with_network(RECIPE, method="batch_ensemble", members=2)
    module = TrainingModule(build_network(recipe.network), recipe, 10)
    groups = module.configure_optimizers()["optimizer"].param_groups
    assert [group["weight_decay"] for group in groups] == [1e-4, 0.0]
    assert len(groups[1]["params"]) == len(module.network.factors())
    assert sum(len(group["params"]) for group in groups) == len(list(module.network.parameters()))


def test_a_split_batch_trains_every_member_on_its_own_images(frames, tmp_path):
    """One prediction per image, the cost of one network; too few images are refused."""
    recipe = replace(with_network(RECIPE, method="batch_ensemble", members=2), split_batch=True, batch_size=4)
    module = TrainingModule(build_network(recipe.network).eval(), recipe, 10)  # batch norm would mix the images
    image = torch.rand(4, 3, *recipe.network.size, generator=torch.Generator().manual_seed(0))
    distribution = module._distribution(image)
    assert len(distribution.depth) == 4
    for n, depth in enumerate(distribution.depth.split(2)):
        factor = module.network.factors()[0]
        (gradient,) = torch.autograd.grad(depth.sum(), factor, retain_graph=True)
        assert [bool(row.any()) for row in gradient] == [n == 0, n == 1]
    fit(tiny_job(frames, tmp_path / "out", replace(recipe, epochs=1, max_steps=1)))


@pytest.mark.parametrize(("average", "log_every", "step"), [(0.0, 1, 1), (0.9, 50, 3)])
def test_a_loss_that_is_not_finite_names_its_step_and_loses_nothing(
    frames, tmp_path, monkeypatch, average, log_every, step
):
    """The second member diverges at the second step of its second epoch; its first epoch and the first member remain.
    Steps that are not logged are not waited for."""
    recipe = replace(RECIPE, members=2, epochs=2, average=average)
    original = TrainingModule._distribution

    def poisoned(module, image):
        distribution = original(module, image)
        bad = module.seed == 1 and module.global_step == 4
        return replace(distribution, log_variance=distribution.log_variance * (float("nan") if bad else 1.0))

    monkeypatch.setattr(TrainingModule, "_distribution", poisoned)
    job = tiny_job(frames, tmp_path / "out", recipe, log_every=log_every)
    with pytest.raises(NonFiniteLossError, match=rf"is not finite in epoch 1, by step {3 + step}; .*remains"):
        fit(job)
    assert len(load_trained(tmp_path / "out" / WEIGHTS)) == 2
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["stopped"] == "failed"
    assert [(m["steps"], m["finished"]) for m in summary["members"]] == [(6, True), (3, False)]
    if average:  # once is enough
        monkeypatch.undo()
        assert fit(job)["stopped"] is None


def test_a_gradient_that_is_not_finite_is_found_before_a_checkpoint(frames, tmp_path, monkeypatch):
    """sqrt(0) has a finite value and no finite gradient."""
    original = TrainingModule._distribution

    def poisoned(module, image):
        distribution = original(module, image)
        return replace(distribution, depth=distribution.depth + (distribution.depth * 0).sqrt())

    monkeypatch.setattr(TrainingModule, "_distribution", poisoned)
    job = tiny_job(frames, tmp_path / "out", replace(ONE_STEP, clip=0.0))
    with pytest.raises(NonFiniteLossError, match="weight is not finite in epoch 0, by step 1"):
        fit(job)
    assert read_checkpoint(job, 0) is None


@pytest.mark.parametrize("method", ["aleatoric", "evidential"])
def test_a_step_does_not_wait_for_the_device(frames, tmp_path, monkeypatch, method):
    """Nothing is copied to the host from the batch's arrival until the optimizer step."""
    recipe = replace(with_network(RECIPE, method=method, dropout=0.2), average=0.0, epochs=1, clip=0.0)
    steps = []

    def guarded(original):
        def call(self, *arguments, **named):
            with pytest.MonkeyPatch.context() as patch:
                if self.trainer.global_step == 1 and self.trainer.training:  # a step whose loss is not logged
                    for name in ("cpu", "numpy", "tolist", "item", "__float__", "__bool__"):
                        patch.setattr(torch.Tensor, name, refused)
                    steps.append(original.__name__)
                return original(self, *arguments, **named)

        return call

    def refused(*_, **__):
        raise AssertionError("a training step reads a tensor on the host")

    monkeypatch.setattr(TrainingModule, "training_step", guarded(TrainingModule.training_step))
    hook = DepthDataModule.on_after_batch_transfer
    monkeypatch.setattr(DepthDataModule, "on_after_batch_transfer", guarded(hook))
    fit(tiny_job(frames, tmp_path / "out", recipe, log_every=50))
    assert steps == ["on_after_batch_transfer", "training_step"]


def test_training_leaves_torchs_random_numbers_alone(frames, tmp_path):
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    fit(tiny_job(frames, tmp_path / "out", ONE_STEP))
    assert torch.equal(torch.rand(3), expected)


# ---- starts ----


def test_an_encoder_that_starts_from_nothing_is_named(ufmstar, frames, tmp_path):
    (tmp_path / "x").write_text("the folder is refused, and nothing is trained")
    words = ["train", "--preset", "monodepth2-aleatoric", "--data", "sequences", "--root", frames, "--out", tmp_path]
    for more, count in (((), 1), (("--init", "imagenet"), 0)):
        assert ufmstar(*words, *more)[2].count("starts from random weights") == count


def test_a_trained_file_is_a_start(tmp_path):
    path = tmp_path / "start.safetensors"
    members = [build_network(SPEC) for _ in range(2)]
    save_trained(path, members, SPEC)
    for n in range(3):
        state = starting_network(SPEC, path, n).state_dict()
        assert all(torch.equal(state[key], value) for key, value in members[n % 2].state_dict().items())
    # Another head on the same backbone, at another size.
    spec = replace(SPEC, method="evidential", size=(64, 32))
    network = starting_network(spec, path)
    for key, value in members[0].backbone.state_dict().items():
        assert torch.equal(network.backbone.state_dict()[key], value)
    assert network.head.out_channels == 3
    with pytest.raises(ValueError, match=r"init: .*start\.safetensors holds .*widths=0\.05.*does not fit"):
        starting_network(replace(SPEC, widths=0.1), path)
    with pytest.raises(FileNotFoundError):
        starting_network(SPEC, tmp_path / "none.safetensors")


@pytest.mark.parametrize("architecture", ["fastdepth", "monodepth2"])
def test_a_batch_ensemble_starts_from_weights_and_near_them(tmp_path, architecture):
    plain = SPEC if architecture == "fastdepth" else NetworkSpec("monodepth2", layers=18, strides="v1", size=(64, 64))
    path = tmp_path / ("start.safetensors" if architecture == "fastdepth" else "resnet.pth")
    torch.manual_seed(0)
    source = build_network(plain)
    if architecture == "fastdepth":
        save_trained(path, source, plain)
    else:
        torch.save(source.backbone.encoder.state_dict(), path)
    torch.manual_seed(1)
    network = starting_network(replace(plain, method="batch_ensemble", members=3), path)
    layers = {name: layer for name, layer in network.network.named_modules() if isinstance(layer, BatchLayer)}
    part = "backbone." if architecture == "fastdepth" else "backbone.encoder."
    filled = {name: layer for name, layer in layers.items() if name.startswith(part)}
    assert len(filled) > 15
    for name, layer in filled.items():
        assert torch.equal(layer.shared.weight, source.get_submodule(name).weight), name
    factors = torch.cat([factor.detach().flatten() for factor in network.factors()])
    assert factors.mean().item() == pytest.approx(1, abs=0.02)
    assert 0.05 < factors.std().item() < 0.15


@pytest.mark.parametrize(("held", "wanted"), [(18, 34), (34, 18)])
def test_a_monodepth2_of_another_resnet_is_refused(tmp_path, held, wanted):
    """The two ResNets share many names and shapes of tensors."""
    network = MonodepthResNet(held)
    torch.save(
        {f"encoder.{key}": value for key, value in network.encoder.state_dict().items()}, tmp_path / "encoder.pth"
    )
    decoder = {
        f"decoder.{2 * (4 - i) + n}.conv.conv.{kind}": getattr(getattr(level, part), kind)
        for i, level in enumerate(network.levels)
        for n, part in enumerate(("before", "after"))
        for kind in ("weight", "bias")
    }
    torch.save(decoder, tmp_path / "depth.pth")
    started = starting_network(NetworkSpec("monodepth2", layers=held), tmp_path)
    assert torch.equal(started.backbone.levels[4].before.weight, network.levels[4].before.weight)
    with pytest.raises(ValueError, match=r"does not fit MonodepthResNet .* another network\.layers may"):
        starting_network(NetworkSpec("monodepth2", layers=wanted), tmp_path)


def test_a_start_that_does_not_fit_is_refused(tmp_path):
    path = tmp_path / "weights.pth"
    torch.save({"conv1.weight": torch.ones(1)}, path)
    with pytest.raises(ValueError, match=r"a fastdepth starts from \.onnx or a trained \.safetensors"):
        starting_network(SPEC, path)
    with pytest.raises(CheckpointError):
        starting_network(NetworkSpec(architecture="monodepth2", layers=18), path)


def test_the_shared_weights_are_starts():
    spec = NetworkSpec(widths="pruned")
    onnx, resnet = require_shared("weights/fastdepth_nyu.onnx"), "weights/resnet50_v1_imagenet_fp16_nofc.pth"
    network = starting_network(spec, onnx)
    with pytest.raises(ValueError, match=r"has batch norms: --set network\.norm=true fits"):
        starting_network(replace(spec, norm=False), onnx)
    from ufmstar_torch.models.fastdepth import FastDepth

    for key, value in FastDepth.from_onnx(onnx).state_dict().items():
        assert torch.equal(network.backbone.state_dict()[key], value)
    with pytest.raises(ValueError, match=r"network\.widths=pruned or full"):
        starting_network(NetworkSpec(widths=0.5), onnx)
    spec = NetworkSpec(architecture="monodepth2", strides="v1")
    weights = torch.load(require_shared(resnet), weights_only=True)
    network = starting_network(spec, require_shared(resnet))
    first = next(key for key in weights if key.endswith("conv1.weight"))
    assert torch.equal(network.backbone.encoder.state_dict()[first], weights[first].float())


def test_a_file_with_folded_batch_norms_names_the_remedy(tmp_path):
    source = build_network(SPEC).eval().backbone
    path = write_fastdepth(tmp_path / "folded.onnx", source.folded(), SPEC.size[0])
    with pytest.raises(ValueError, match=r"folded\.onnx has folded batch norms: --set network\.norm=false fits"):
        starting_network(SPEC, path)
    network = starting_network(replace(SPEC, norm=False), path)
    assert torch.equal(network.backbone.head.conv.weight, source.folded().head.conv.weight)


def test_only_the_named_part_is_trained(frames, tmp_path):
    job = tiny_job(frames, tmp_path / "out", replace(ONE_STEP, average=0.0), trainable=("head", "backbone.decoder.4"))
    before = {key: value.clone() for key, value in new_network(job, 0).state_dict().items()}
    fit(job)
    after = trained(job).state_dict()
    # Batch norms of untrained parts keep their statistics, too.
    changed = {key for key in before if not torch.equal(before[key], after[key])}
    assert {".".join(key.split(".")[:3]) for key in changed} == {"head.weight", "head.bias", "backbone.decoder.4"}


# ---- command line ----


def words(frames, out, *more):
    base = ["train", "--preset", "fastdepth-aleatoric", "--data", "sequences", "--root", frames, "--out", out]
    settings = ("data.part=0:12", "data.validation_part=12:16", "network.size=[32,32]", "network.widths=0.05")
    base += [f"--set={setting}" for setting in settings]
    base += ["--accelerator", "cpu", "--batch-size", "4", "--no-tensorboard", "--no-progress"]
    return [*base, *more]


def test_a_training_by_command(ufmstar, frames, tmp_path):
    code, out, err = ufmstar(*words(frames, tmp_path / "out", "--max-steps", 2, "--members", 2))
    assert (code, err) == (0, "")
    assert out.splitlines()[0].split()[:3] == ["member", "steps", "seconds"]
    assert [line.split()[:2] for line in out.splitlines()[1:3]] == [["0", "2"], ["1", "2"]]
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["command"][:4] == ["ufmstar", "train", "--preset", "fastdepth-aleatoric"]
    assert Recipe.from_dict(summary["recipe"]).network.widths == 0.05
    code, _, err = ufmstar(*words(frames, tmp_path / "out", "--max-steps", 3, "--members", 2))
    assert code == 1
    assert re.fullmatch(r"ufmstar train: failed: .* started with other input: .*--overwrite replaces it\n", err)
    code, _, err = ufmstar(*words(frames, tmp_path / "out", "--max-steps", 2, "--members", 2))
    assert (code, err) == (0, "")


def test_a_dry_run_prints_the_plan_and_writes_nothing(ufmstar, frames, tmp_path):
    code, out, err = ufmstar(*words(frames, tmp_path / "out", "--dry-run", "--members", 2, "--seed", 3))
    assert (code, err) == (0, "")
    *lines, last = out.splitlines()
    values = dict(line.split(maxsplit=1) for line in lines)
    assert (values["members"], values["network.size"], values["data.part"], values["seed"]) == (
        "2", "[32, 32]", "0:12", "3",
    )  # fmt: skip
    sections = {name.rpartition(".")[::2] for name in values}
    settable = {(section, name) for section, without in _WITHOUT.items() for name in (*_fields_of(section), *without)}
    assert sections - settable <= {("", name) for name in ("seed", "init", "trainable")}, "names of --set, or options"
    assert last == "12 frames to train on, 4 to validate on; at most 150 steps for each of 2 trained networks"
    more = ("--preset", "fastdepth-aleatoric", "--data", "tour", "--out", tmp_path / "out", "--dry-run")
    assert (
        "4000 frames to train on, 320 to validate on; at most 25000 steps for each of 1" in ufmstar("train", *more)[1]
    )
    assert not (tmp_path / "out").exists()


def test_a_file_that_cannot_be_read_ends_a_training_in_a_line(ufmstar, tmp_path):
    path = write_frames(tmp_path / "walk")
    for file in (path / "depth").iterdir():
        file.write_bytes(b"no depth")
    code, _, err = ufmstar(*words(path, tmp_path / "out", "--max-steps", 1))
    assert code == 1
    assert re.search(r"ufmstar train: failed: walk/\S+: .*--set data.on_bad_file=skip", err), err


def test_a_stopped_training_says_how_to_go_on(ufmstar, frames, tmp_path):
    code, _, err = ufmstar(*words(frames, tmp_path / "out", "--max-minutes", 1e-9))
    assert (code, err) == (130, "ufmstar train: time budget spent; the same command goes on\n")


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--learning-speed", "2"], "Unrecognized options: --learning-speed, 2"),
        (["--data", "tour"], "--data tour takes no --root"),
        (["--threads", "0"], "--threads must be at least 1"),
        (["--set", "widths=2"], r"--set has no widths; expected epochs, .*, network\., augment\., data\., session\."),
        (["--set", "network.width=2"], r"--set has no network.width; expected network\.architecture, .*preprocess$"),
    ],
)
def test_mistakes_are_one_line(ufmstar, frames, tmp_path, more, told):
    code, out, err = ufmstar(*words(frames, tmp_path / "out", *more))
    assert (code, out) == (2, "")
    assert err.startswith("ufmstar train: ")
    assert err.count("\n") == 1
    assert re.search(told, err)
    assert not (tmp_path / "out").exists()
