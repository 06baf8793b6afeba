"""Depth Anything V2 and other models of ``transformers``: tiny random checkpoints, saved and loaded."""

from __future__ import annotations

import json
import shutil

import pytest
import torch
from depth_anything_files import MEAN, STD, write_depth_anything, write_other
from layouts import write_generic
from runs import read_summary
from safetensors.torch import load_file, save_file

from scenes import camera_pose, render
from ufmstar_torch import UncertainDepth, cli
from ufmstar_torch.eval.engine.load import NetworkChoice, sha256
from ufmstar_torch.gaussians.camera import resize_intrinsics
from ufmstar_torch.models import (
    CheckpointError,
    DepthAnything,
    Preprocess,
    fit_inverse_depth,
    from_hugging_face,
    load_network,
)

transformers = pytest.importorskip("transformers")

K = torch.tensor([[525.0, 0, 319.5], [0, 520.0, 239.5], [0, 0, 1]], dtype=torch.float64)


@pytest.fixture(scope="module")
def metric(tmp_path_factory):
    """A directory with a metric checkpoint. Tests must not change it."""
    return write_depth_anything(tmp_path_factory.mktemp("hub") / "metric", "metric")


@pytest.fixture(scope="module")
def relative(tmp_path_factory):
    """A directory with a relative checkpoint. Tests must not change it."""
    return write_depth_anything(tmp_path_factory.mktemp("hub") / "relative", "relative")


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    """A GLPN, whose configuration does not state the kind of its depth."""
    folder = write_other(tmp_path_factory.mktemp("hub") / "glpn", "glpn", 3)
    saying = {"image_processor_type": "GLPNImageProcessor", "size_divisor": 32, "resample": 2, "do_normalize": False}
    (folder / "preprocessor_config.json").write_text(json.dumps(saying))
    return folder


@pytest.fixture
def broken(metric, tmp_path):
    """A copy of the metric checkpoint to damage."""
    return shutil.copytree(metric, tmp_path / "broken")


def photos(number=2, size=(48, 64), seed=0):
    """Images with edges and slopes: the rendered room, in colours by depth."""
    poses = [camera_pose((-0.5 + 0.2 * i + 0.1 * seed, -0.2, -0.9), 0.05 * i, 0.05) for i in range(number)]
    camera = torch.tensor([[size[1] * 0.9, 0, size[1] / 2], [0, size[1] * 0.9, size[0] / 2], [0, 0, 1]]).numpy()
    depth = torch.stack([torch.from_numpy(render(T, camera, *size)) for T in poses])
    return torch.stack([(40 * depth) % 256, 255 / (1 + depth), (90 * depth) % 256], 1).to(torch.uint8)


def own_processor(folder, images, **changes):
    """Uint8 images [B, 3, H, W] through the checkpoint's own image processor."""
    processor = transformers.DPTImageProcessor.from_pretrained(folder, **changes)
    return processor(list(images), return_tensors="pt")["pixel_values"]


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_weights_give_single_precision_depth(metric, dtype):
    x = DepthAnything.from_pretrained(metric, size=(70, 70)).preprocess.apply_image(photos(1))
    half = DepthAnything.from_pretrained(metric, size=(70, 70), dtype=dtype)
    assert next(half.parameters()).dtype == dtype
    with torch.no_grad():
        depth = half(x).depth
        full = DepthAnything.from_pretrained(metric, size=(70, 70))(x).depth
    assert depth.dtype == torch.float32
    torch.testing.assert_close(depth, full, rtol=0.1, atol=0.1)


def test_inputs_that_do_not_fit_are_refused(metric):
    with pytest.raises(ValueError, match=r"size must be .* multiples of the patch, 14 px, got \(500, 518\)"):
        DepthAnything.from_pretrained(metric, size=(500, 518))
    network = DepthAnything.from_pretrained(metric)
    with pytest.raises(ValueError, match="multiples of 14 px, got 70 x 80"):
        network(torch.zeros(1, 3, 70, 80))
    for image in (torch.zeros(3, 70, 70), torch.zeros(1, 1, 70, 70), torch.zeros(1, 3, 70, 70, dtype=torch.uint8)):
        with pytest.raises(ValueError, match="image must be floating-point"):
            network(image)


def test_a_relative_checkpoint_is_no_depth_network_until_it_is_aligned(relative):
    K_photo = resize_intrinsics(K, (480, 640), (48, 64))
    network = DepthAnything.from_pretrained(relative, size=(70, 84))
    x, K_net = network.preprocess(photos(1), K_photo)
    assert (network.kind, network.is_metric) == ("inverse", False)
    with pytest.raises(ValueError, match=r"predicts relative depth .*inverse depth up to scale and shift"):
        network(x)
    with pytest.raises(ValueError, match="fit_inverse_depth"):
        UncertainDepth(network, preprocess=network.preprocess)(photos(1), torch.eye(4), K_photo)
    with torch.no_grad():
        raw = network.raw(x)
        reference = transformers.DepthAnythingForDepthEstimation.from_pretrained(relative).eval()
        torch.testing.assert_close(raw, reference(pixel_values=x).predicted_depth, rtol=1e-6, atol=1e-6)
        truth = 1 / (0.05 * raw + 0.1)
        measured = torch.where(torch.rand(truth.shape, generator=torch.Generator().manual_seed(0)) < 0.02, truth, 0)
        aligned = network.aligned(fit_inverse_depth(raw, measured, pooled=True).alignment)
        torch.testing.assert_close(aligned(x).depth, truth, rtol=1e-4, atol=0)
    out = UncertainDepth(aligned, preprocess=aligned.preprocess)(photos(1), torch.eye(4, dtype=torch.float64), K_photo)
    torch.testing.assert_close(out.depth, truth, rtol=1e-4, atol=0)
    torch.testing.assert_close(out.intrinsics[0], K_net)
    assert out.variance.isfinite().any()


@pytest.mark.parametrize("keep_aspect", [False, True])
def test_colours_are_the_own_processor_s_to_its_rounding(metric, keep_aspect):
    """Both resample bytes by the same function of torch, so only the normalisation rounds differently."""
    image = photos(2, (480, 640))
    ours = DepthAnything.from_pretrained(metric, keep_aspect=keep_aspect).preprocess.apply_image(image)
    theirs = own_processor(metric, image, keep_aspect_ratio=keep_aspect)
    levels = (ours - theirs).abs() * torch.tensor(STD)[:, None, None] * 255
    assert levels.max() < 1e-3
    linear = Preprocess(size=ours.shape[-2:], mean=MEAN, std=STD).apply_image(image)
    assert (linear - theirs).abs().mean() > 1.5 * (ours - theirs).abs().mean()  # the filter matters


def test_an_image_processor_may_be_missing_or_say_something_else(broken):
    file = broken / "preprocessor_config.json"
    says = json.loads(file.read_text())
    file.unlink()
    with pytest.raises(ValueError, match=r"broken has no preprocessor_config\.json, .*copy it there"):
        DepthAnything.from_pretrained(broken)
    file.write_text(json.dumps(says | {"image_mean": [0.5, 0.5, 0.5], "resample": 2}))
    assert DepthAnything.from_pretrained(broken).preprocess == Preprocess(
        size=(518, 518), mean=(0.5, 0.5, 0.5), std=STD
    )
    file.write_text(json.dumps(says | {"do_normalize": False, "do_rescale": False}))
    assert DepthAnything.from_pretrained(broken).preprocess == Preprocess(
        size=(518, 518), value_range=255.0, cubic=True
    )
    for change in ({"resample": 1}, {"do_center_crop": True}):
        file.write_text(json.dumps(says | change))
        with pytest.raises(ValueError, match="is not supported: declare another one in a spec"):
            DepthAnything.from_pretrained(broken)
    file.write_text("{")
    with pytest.raises(CheckpointError, match=r"broken: preprocessor_config\.json cannot be read"):
        DepthAnything.from_pretrained(broken)


def edit_weights(folder, edit):
    file = folder / "model.safetensors"
    save_file(edit(load_file(file)), file, metadata={"format": "pt"})


def edit_config(folder, **changes):
    file = folder / "config.json"
    values = json.loads(file.read_text()) | changes
    file.write_text(json.dumps({name: value for name, value in values.items() if value != "drop"}))


def cut(folder):
    file = folder / "model.safetensors"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


DAMAGES = {
    "cut off": (cut, "cannot be loaded as a depth model"),
    "garbage": (lambda d: (d / "model.safetensors").write_bytes(b"weights" * 9), "cannot be loaded as a depth model"),
    "empty": (lambda d: (d / "model.safetensors").write_bytes(b""), "cannot be loaded as a depth model"),
    "no weights": (lambda d: (d / "model.safetensors").unlink(), "cannot be loaded as a depth model"),
    "a weight missing": (
        lambda d: edit_weights(d, lambda s: {k: v for k, v in s.items() if k != "head.conv3.weight"}),
        "lacks weights, which would stay random: head.conv3.weight",
    ),
    "another shape": (
        lambda d: edit_weights(d, lambda s: s | {"head.conv3.bias": torch.zeros(3)}),
        "cannot be loaded as a depth model",
    ),
    "not finite": (
        lambda d: edit_weights(d, lambda s: s | {"head.conv3.bias": torch.tensor([float("nan")])}),
        "weights that are not finite: head.conv3.bias",
    ),
    "config no JSON": (lambda d: (d / "config.json").write_text("{"), "config.json cannot be read"),
    "config a list": (lambda d: (d / "config.json").write_text("[]"), "config.json"),
    "another model": (lambda d: edit_config(d, model_type="bert"), "is a 'bert' model, expected 'depth_anything'"),
    "no model": (lambda d: edit_config(d, model_type="drop"), "is a None model"),
    "impossible value": (lambda d: edit_config(d, max_depth="far"), "cannot be loaded as a depth model"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_named(broken, damage):
    edit, message = DAMAGES[damage]
    edit(broken)
    with pytest.raises(CheckpointError, match=message) as caught:
        DepthAnything.from_pretrained(broken)
    assert str(broken) in str(caught.value)


def test_missing_directories_are_named(broken, tmp_path):
    (broken / "config.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"broken has no config\.json"):
        DepthAnything.from_pretrained(broken)
    with pytest.raises(FileNotFoundError, match=r"no such directory: .*nowhere"):
        DepthAnything.from_pretrained(tmp_path / "nowhere")


def test_a_hub_name_without_a_connection_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(OSError, match=r"(?s)Small-hf is no directory and cannot be read.*--local-dir DIR") as caught:
        DepthAnything.from_pretrained("depth-anything/Depth-Anything-V2-Small-hf", local_files_only=True)
    assert isinstance(caught.value.__cause__, OSError)


def test_another_model_in_one_line_with_its_meaning_declared(other):
    images = photos(1, (64, 96))
    with pytest.raises(ValueError, match=r"\(glpn\) does not state whether its depth is metric: declare kind='metric'"):
        from_hugging_face(other, size=(64, 96))
    network = from_hugging_face(other, kind="metric", scale=2.0, size=(64, 96))
    assert network.preprocess == Preprocess(size=(64, 96))
    reference = transformers.GLPNForDepthEstimation.from_pretrained(other).eval()
    with torch.no_grad():
        expected = reference(pixel_values=images.float() / 255).predicted_depth
        torch.testing.assert_close(network(network.preprocess(images, K)[0]).depth, 2 * expected, rtol=1e-5, atol=1e-5)
    affine = from_hugging_face(other, kind="affine", size=(64, 96))
    with pytest.raises(ValueError, match=r"\(depth up to scale and shift\), not metres"):
        affine(images.float() / 255)
    with pytest.raises(ValueError, match=r"preprocessor_config\.json states no size with height and width: declare it"):
        from_hugging_face(other, kind="metric")
    with pytest.raises(ValueError, match="scale goes with kind 'metric' only"):
        from_hugging_face(other, kind="affine", scale=2.0, size=(64, 96))
    with pytest.raises(ValueError, match="preprocess excludes size"):
        from_hugging_face(other, kind="metric", size=(64, 96), preprocess=Preprocess())
    with pytest.raises(ValueError, match="kind must be one of"):
        from_hugging_face(other, kind="depth", size=(64, 96))


def test_what_a_configuration_says_may_not_be_contradicted(metric, relative):
    assert from_hugging_face(metric).kind == "metric"
    assert from_hugging_face(relative, kind="inverse").kind == "inverse"
    assert from_hugging_face(metric).preprocess.aspect_multiple == 14
    assert from_hugging_face(metric, keep_aspect=False).preprocess == DepthAnything.from_pretrained(metric).preprocess
    assert (from_hugging_face(metric).max_depth, from_hugging_face(metric, scale=0.5).max_depth) == (20.0, 10.0)
    assert from_hugging_face(relative, kind="inverse").max_depth is None
    with pytest.raises(ValueError, match="states depth_estimation_type 'relative', which is 'inverse'"):
        from_hugging_face(relative, kind="metric")


def test_smaller_outputs_are_enlarged_to_the_input(other):
    network = from_hugging_face(other, kind="metric", size=(64, 96))

    class Half(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = torch.nn.Parameter(torch.ones(()))

        def forward(self, pixel_values):
            ramp = torch.arange(pixel_values.shape[-1] // 2).float().expand(len(pixel_values), 1, 32, -1)
            return transformers.modeling_outputs.DepthEstimatorOutput(predicted_depth=ramp + self.weight)

    network.raw.model = Half()
    depth = network(torch.zeros(2, 3, 64, 96)).depth
    inner = depth[:, :, 1:-1]
    ramp = ((torch.arange(1, 95) + 0.5) / 2 + 0.5).expand_as(inner)
    torch.testing.assert_close(inner, ramp, rtol=0, atol=0.1)  # the image processor's cubic filter overshoots by .08


def test_weights_that_a_model_does_not_use_may_be_missing(broken):
    edit_weights(broken, lambda state: {k: v for k, v in state.items() if not k.startswith("head.conv3")})
    with pytest.raises(CheckpointError, match="name them in allow_missing"):
        from_hugging_face(broken, allow_missing=["head.conv2"])
    assert from_hugging_face(broken, allow_missing=["head.conv3"]).kind == "metric"


@pytest.mark.parametrize("architecture", ["depth_anything", "depth_pro", "dpt", "glpn", "zoedepth"])
def test_depth_is_what_transformers_own_post_processing_makes_of_it(architecture, tmp_path):
    """Depth Pro's inverse depth with its field of view, ZoeDepth's padding; the others unchanged."""
    if architecture == "depth_anything":
        folder, size = write_depth_anything(tmp_path / "model", "metric"), (70, 70)
    else:
        folder, size = write_other(tmp_path / "model", architecture), (64, 64)
    kind = {"dpt": "inverse", "glpn": "metric"}.get(architecture)
    network = from_hugging_face(folder, kind=kind, size=size)
    images = photos(2, size)
    processor = transformers.AutoImageProcessor.from_pretrained(folder, use_fast=True)
    model = transformers.AutoModelForDepthEstimation.from_pretrained(folder).eval()
    x = network.preprocess.apply_image(images)
    options = {"target_sizes": [size] * 2}
    with torch.no_grad():
        raw = network.raw(x)
        if architecture == "zoedepth":  # pads the images itself
            x = processor(list(images), return_tensors="pt")["pixel_values"]
            options = {"source_sizes": [size] * 2}
        outputs = processor.post_process_depth_estimation(model(pixel_values=x), **options)
    expected = torch.stack([output["predicted_depth"].squeeze() for output in outputs])
    torch.testing.assert_close(raw, expected, rtol=1e-4, atol=1e-4)
    assert float(raw.std() / raw.mean()) > 0.01
    assert not network.training
    if network.is_metric:
        with torch.no_grad():
            prediction = network(network.preprocess.apply_image(images))
        assert torch.equal(prediction.depth, raw)
        assert prediction.variance is None


def test_architectures_that_are_always_metric_need_no_declaration(tmp_path):
    for architecture in ("depth_pro", "zoedepth"):
        folder = write_other(tmp_path / architecture, architecture)
        assert from_hugging_face(folder).kind == "metric"
        with pytest.raises(ValueError, match=f"states the architecture {architecture}, which is 'metric'"):
            from_hugging_face(folder, kind="inverse")


COMPARED = ("depth_anything", "depth_pro", "dpt", "glpn", "zoedepth")
SHIPPED = transformers.models.auto.modeling_auto.MODEL_FOR_DEPTH_ESTIMATION_MAPPING_NAMES


@pytest.mark.parametrize("architecture", [*sorted(set(SHIPPED) - set(COMPARED)), "bert", None])
def test_other_architectures_are_refused_by_name(broken, architecture):
    """Every other architecture of ``AutoModelForDepthEstimation``, and models that do not predict depth."""
    (broken / "config.json").write_text(json.dumps({"model_type": architecture}))
    with pytest.raises(CheckpointError, match=rf"broken \({architecture}\) cannot be loaded as a depth model: covered"):
        from_hugging_face(broken, kind="metric")


def test_networks_by_name(metric, relative, other):
    network = load_network("depth_anything", metric, spec={"size": [70, 84]})
    assert isinstance(network, DepthAnything)
    assert network.preprocess.size == (70, 84)
    with pytest.raises(ValueError, match=r'in a spec: {"alignment": {"kind": "inverse"'):
        load_network("depth_anything", relative)
    glpn = load_network("huggingface", other, spec={"kind": "metric", "preprocess": {"size": [64, 96]}})
    assert glpn.preprocess == Preprocess(size=(64, 96))
    with pytest.raises(ValueError, match="Spec has no \\['kinds'\\]"):
        load_network("depth_anything", metric, spec={"kinds": "metric"})


def test_the_command_line_runs_a_directory(relative, tmp_path, capsys):
    sequence = write_generic(tmp_path / "scene")[0]
    spec, out = tmp_path / "spec.json", tmp_path / "out"
    words = ["run", str(sequence), "--out", str(out), "--spec", str(spec), "--no-video", "--no-sheet", "--frames", ":2"]
    words += ["--model", "depth_anything", "--weights"]
    spec.write_text(json.dumps({"size": [42, 56], "alignment": {"kind": "inverse", "scale": 0.05, "shift": 0.1}}))
    assert cli.main([*words, str(relative)]) == 0
    assert read_summary(out)["state"] == "finished"
    capsys.readouterr()
    assert cli.main([*words, str(tmp_path / "none"), "--overwrite"]) != 0
    assert "hf download NAME --local-dir DIR" in capsys.readouterr().err


def test_a_directory_is_identified_by_its_visible_files(broken, metric):
    assert sha256(broken) == sha256(metric)
    (broken / ".cache").mkdir()
    (broken / ".cache" / "lock").write_text("x")
    assert sha256(broken) == sha256(metric)
    edit_weights(broken, lambda state: state | {"head.conv3.bias": state["head.conv3.bias"] + 1})
    assert sha256(broken) != sha256(metric)
    shutil.copy(metric / "model.safetensors", broken / "model.safetensors")
    assert sha256(broken) == sha256(metric)
    (broken / "config.json").rename(broken / "config2.json")
    assert sha256(broken) != sha256(metric)
    identity = NetworkChoice("", "depth_anything", (str(metric),)).load(torch.device("cpu")).identity
    assert identity["files"] == [{"name": "metric", "sha256": sha256(metric), "member": None}]
