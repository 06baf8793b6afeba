"""Accepted forms of images, maps, poses and intrinsics; and refusals, whose errors name the argument."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial

import numpy as np
import pytest
import torch
from modules import CONFIG, H, K, W, frame, same
from PIL import Image
from torch import nn

from ufmstar_torch import AnchorConfig, DepthPrediction, UfMStar, UfMStarConfig, UncertainDepth
from ufmstar_torch import uncertain_depth as pipeline
from ufmstar_torch.anchors import Anchors, LandmarkMap
from ufmstar_torch.config import SPGFConfig
from ufmstar_torch.frames.prediction import combine
from ufmstar_torch.gaussians.camera import crop_intrinsics, resize_intrinsics
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.models import Preprocess, load_network, save_checkpoint, wrap_network
from ufmstar_torch.posterior.recalibrate import Recalibration

DEPTH, POSE, _ = frame(0)
IMAGE = torch.randint(0, 255, (1, 3, H, W), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
PICTURE = IMAGE[0].permute(1, 2, 0).contiguous().numpy()
FX, FY, CX, CY = (float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
K4 = torch.eye(4, dtype=torch.float64)
K4[:3, :3] = K


class Brightness(nn.Module):
    """Depth is the mean colour."""

    def forward(self, image):
        return DepthPrediction(1 + image.float().mean(1) / 100)


def ufm(*frame, **options):
    return UfMStar(CONFIG)(*frame, **options)


def model(image, *camera, network=None, **options):
    return UncertainDepth(network or Brightness(), CONFIG, **options)(image, *(camera or (POSE, K)))


def seen():
    module = UfMStar(CONFIG)
    module(DEPTH, POSE, K)
    return module


REFUSED = {
    "depth as a single map": (lambda: ufm(DEPTH[0], POSE, K), ValueError, r"depth must .* single map is depth\[None\]"),
    "depth of five dimensions": (lambda: ufm(DEPTH[:, None, None], POSE, K), ValueError, "depth must be"),
    "depth without rows": (lambda: ufm(DEPTH[:, :0], POSE, K), ValueError, "depth must be"),
    "depth in millimetres": (lambda: ufm(DEPTH.short(), POSE, K), TypeError, "depth must have a floating-point dtype"),
    "depth as a list": (lambda: ufm([[1.0]], POSE, K), TypeError, "depth must be a torch.Tensor or a NumPy array"),
    "depth of objects": (lambda: ufm(np.array([None]), POSE, K), TypeError, "depth .*got an array of object"),
    "depth of other streams": (
        lambda: seen()(DEPTH.expand(2, H, W), POSE, K), ValueError, r"depth has 2 streams .*call reset\(\)"
    ),
    "pose of 3 x 3": (lambda: ufm(DEPTH, torch.eye(3), K), ValueError, r"pose must be camera-to-world \[B, 4, 4\]"),
    "pose of other streams": (lambda: ufm(DEPTH, POSE.expand(3, 4, 4), K), ValueError, "pose must have depth's 1"),
    "pose as text": (lambda: ufm(DEPTH, ["a"], K), TypeError, "pose must hold numbers"),
    **{
        f"pose and intrinsics swapped, {name}": (call, ValueError, "pose must be .*are these the intrinsics")
        for name, call in {
            "as matrices": lambda: ufm(DEPTH, K, POSE),
            "as numbers": lambda: ufm(DEPTH, (FX, FX, CX, CY), POSE[:3]),
            "of the whole model": lambda: UncertainDepth(nn.Conv2d(3, 1, 1))(torch.zeros(1, 3, H, W), K, POSE),
        }.items()
    },
    "intrinsics that are a pose": (lambda: ufm(DEPTH, POSE, frame(3)[1]), ValueError, "intrinsics .*is this the pose"),
    "intrinsics of 2 x 3": (lambda: ufm(DEPTH, POSE, K[:2]), ValueError, "intrinsics must be .*fx, fy, cx, cy"),
    "intrinsics of three numbers": (lambda: ufm(DEPTH, POSE, (FX, CX, CY)), ValueError, "intrinsics must be"),
    "intrinsics of an image twice as large": (
        lambda: ufm(DEPTH, POSE, (2 * FX, 2 * FY, 2 * W, 2 * H)), ValueError, "principal point outside the depth map"
    ),
    "intrinsics that are missing": (lambda: ufm(DEPTH, POSE, None), TypeError, "intrinsics must be a torch.Tensor or"),
    "aleatoric of another size": (lambda: ufm(DEPTH, POSE, K, DEPTH[:, 1:]), ValueError, "aleatoric must have shape"),
    "aleatoric elsewhere": (lambda: ufm(DEPTH, POSE, K, DEPTH.to("meta")), ValueError, "aleatoric must lie on"),
    "epistemic in whole numbers": (lambda: ufm(DEPTH, POSE, K, None, DEPTH.int()), TypeError, "epistemic must have"),
    "valid as a weight": (lambda: ufm(DEPTH, POSE, K, valid=DEPTH), TypeError, "valid must be a torch.bool"),
    "valid of another size": (lambda: ufm(DEPTH, POSE, K, valid=DEPTH[:, 1:] > 0), ValueError, "valid must have"),
    "anchors that are off": (lambda: ufm(DEPTH, POSE, K, anchors=1), ValueError, "anchors must be None where"),
    "an unknown argument": (lambda: ufm(DEPTH, POSE, K, ancors=1), TypeError, "unexpected keyword argument 'ancors'"),
    "a config that is a dict": (lambda: UfMStar({}), TypeError, "config must be a UfMStarConfig"),
    "a state in half precision": (lambda: UfMStar(dtype=torch.float16), ValueError, "dtype must be torch.float32"),
    **{
        f"a sample of {sample}": (lambda s=sample: seen().mean_uncertainty(DEPTH, POSE, K, **s), ValueError, name)
        for sample, name in (
            ({"pixels": 0}, "pixels"), ({"pixels": H * W + 1}, "pixels"), ({"fraction": 0.0}, "fraction"),
            ({"fraction": 1.5}, "fraction"), ({"pixels": 5, "fraction": 0.5}, "pixels or fraction"),
        )
    },
    "points of other streams": (lambda: seen().query(torch.zeros(2, 5, 3)), ValueError, r"points must be \[1, N, 3\]"),
    "points without streams": (lambda: seen().query(torch.zeros(5, 3)), ValueError, r"points must be \[1, N, 3\]"),
    "points in the plane": (lambda: seen().query(torch.zeros(1, 5, 2)), ValueError, r"points must be \[1, N, 3\]"),
    "points of no mixture": (lambda: UfMStar().query(torch.zeros(1, 5, 3)), ValueError, "query needs a mixture"),
    "an image of one channel": (lambda: model(IMAGE[:, :1]), ValueError, r"image must be \[B, 3, H, W\]"),
    "a tensor with channels last": (lambda: model(torch.tensor(PICTURE)[None]), ValueError, "image .*permute"),
    "an array with channels first": (lambda: model(IMAGE.numpy()), ValueError, r"image as a NumPy array .*\[H, W, 3\]"),
    "an array with transparency": (
        lambda: model(np.zeros((H, W, 4), np.uint8)), ValueError, r"image as a NumPy array must be .*\(30, 40, 4\)"
    ),
    "an image that is a file's name": (lambda: model("a.png"), TypeError, "image must be .*Pillow image, got str"),
    "bytes for a network of floats": (
        lambda: model(IMAGE, network=nn.Conv2d(3, 1, 1), preprocess=None), TypeError, "image of torch.uint8: pass flo"
    ),
    "an array for a wrapped network": (
        lambda: wrap_network(Brightness())(PICTURE), TypeError, r"image must be a tensor .*network.preprocess"
    ),
    "a network that returns no map": (
        lambda: model(IMAGE, network=nn.Identity()), ValueError, r"output 'depth' must be \[B, 1, H, W\]"
    ),
    "a tensor where the core is alone": (
        lambda: pipeline.UncertainDepth(nn.Conv2d(3, 1, 1))(IMAGE, POSE, K), TypeError, "DepthPrediction, got Tensor: w"
    ),
    "a function where the core is alone": (
        lambda: pipeline.UncertainDepth(ufm), TypeError, r"networks .*got a function; wrap .*wrap_network\(network\)"
    ),
    "networks of different inputs": (
        lambda: UncertainDepth([wrap_network(ufm, preprocess=Preprocess(size=(8, n))) for n in (8, 9)]),
        ValueError, "networks must have the same preprocess",
    ),
    "a number among networks": (lambda: UncertainDepth([3], CONFIG), TypeError, "function, got int$"),
    "a file as network": (lambda: UncertainDepth("w.pth"), TypeError, "got str 'w.pth': load it, as load_network"),
    "weights as network": (lambda: UncertainDepth({"w": 1}), TypeError, "weights need their network"),
    "a class as network": (lambda: UncertainDepth(nn.ReLU), TypeError, "the class ReLU: pass an instance"),
    "no network": (lambda: UncertainDepth([]), ValueError, "networks must hold at least one"),
    "no networks for an image": (
        lambda: UncertainDepth(None)(IMAGE, POSE, K), ValueError, "no networks: pass predictions to update"
    ),
    "an unknown mode": (lambda: model(IMAGE, mode="all"), ValueError, "mode must be 'alternate' or 'full'"),
    "all of one network": (lambda: model(IMAGE, mode="full"), ValueError, "mode 'full' needs several networks"),
    "samples in turn": (lambda: model(IMAGE, samples=10), ValueError, "samples must be at least 2"),
    "samples of several": (
        lambda: UncertainDepth([Brightness()] * 2, mode="full", samples=3), ValueError, "samples must be at least 2"
    ),

    "anchors of another type": (
        lambda: UncertainDepth(Brightness(), UfMStarConfig(anchors=AnchorConfig()), anchors=True),
        TypeError, "anchors must be 'corners', 'dense', a file's name or a LandmarkSource, got True",
    ),
    "an unknown source of anchors": (
        lambda: UncertainDepth(Brightness(), UfMStarConfig(anchors=AnchorConfig()), anchors="cornes"),
        ValueError, "anchors: 'cornes' is neither 'corners', 'dense' nor a file",
    ),
    "a size in place of a height": (lambda: Preprocess((224, 224)), ValueError, r"resize_height .*size=\(224, 224"),
    "no prediction": (lambda: combine([]), ValueError, "predictions must not be empty"),
    "a prediction without streams": (lambda: DepthPrediction(torch.ones(2, 2)), ValueError, "depth must be"),
    "a prediction of a list": (lambda: DepthPrediction([1.0]), TypeError, "depth must be a torch.Tensor or a NumPy"),
    "a variance of another size": (
        lambda: DepthPrediction(DEPTH, DEPTH[:, 1:]), ValueError, "aleatoric_variance must have the depth's shape"
    ),
    "a confidence of another size": (
        lambda: DepthPrediction(DEPTH, confidence=DEPTH[:, 1:]), ValueError, "confidence must have the depth's"
    ),
    "a confidence that is not used": (
        lambda: ufm(DEPTH, POSE, K, confidence=DEPTH), ValueError, "confidence must be None where"
    ),
    "a confidence in whole numbers": (
        lambda: UfMStar(CONFIG.replace(anchors=AnchorConfig(), confidence=True))(
            DEPTH, POSE, K, confidence=DEPTH.int()
        ),
        TypeError, "confidence must have a floating-point",
    ),
    "an empty batch": (lambda: model(IMAGE[:0]), ValueError, r"image must be \[B, 3, H, W\] RGB"),
    "a network twice": (lambda: UncertainDepth([Brightness()] * 2), ValueError, "networks must differ"),
    "a config of plain values": (
        lambda: UncertainDepth(Brightness(), {"eta": 0.4}), TypeError, "config must be a UfMStarConfig .*got dict"
    ),
    "a recalibration's file": (
        lambda: model(IMAGE, recalibration="a.json"), TypeError, "recalibration must be a Recal.*got str"
    ),
    "a size as preprocess": (
        lambda: model(IMAGE, network=nn.Conv2d(3, 1, 1), preprocess=(8, 8)), TypeError, r"preprocess must .*\(8, 8\)"
    ),
    "a pose of coarse numbers": (
        lambda: ufm(DEPTH, far(torch.float32), K), ValueError, "pose .* its dtype is exact to 1 cm .*expected float64"
    ),
    "a pose of half precision": (
        lambda: ufm(DEPTH, far(torch.float16, 20.0), K), ValueError, "its dtype is exact to 1 cm .*expected float64"
    ),
    "an image size in text": (lambda: SPGFConfig().scaled_to("480", 640), TypeError, "height must be a whole number"),
    "a rotation of an array": (
        lambda: GaussianMixture.empty(1, 2, dtype=torch.float32, device="cpu").rigid(np.eye(3), torch.zeros(1, 3)),
        TypeError, r"R must be a dense torch\.Tensor, got nd",
    ),
    "a camera of numbers": (
        lambda: Anchors(torch.zeros(1, 2, 2), torch.ones(1, 2), torch.ones(1, 2)).moved([1.0], K),
        TypeError, r"K_from must be a dense torch\.Tensor, got list of float",
    ),
    "a map of text": (lambda: LandmarkMap("abc", None), TypeError, "points_world and sigma must be arrays of numbers"),
    "a map without knots": (lambda: Recalibration((), ()), ValueError, "Recalibration needs knots"),
}  # fmt: skip


def far(dtype, metres=5e6):
    """A pose so far from the origin."""
    T = torch.eye(4, dtype=torch.float64)
    T[1, 3] = metres
    return T.to(dtype)


WRONG = (
    *(None, "text", b"bytes", 5, 3.5, float("nan"), True, [], {}, object(), ["a"], 10**400, nn.Conv2d(3, 1, 1)),
    *(np.array("a"), np.zeros(3), torch.zeros(()), torch.zeros(2, 3, 4, 5, 6), torch.zeros(3, dtype=torch.bool)),
    *(torch.zeros(1, H, W, device="meta"), UfMStarConfig()),
)
GOOD = {"depth": DEPTH, "pose": POSE, "intrinsics": K}
IMAGE_GOOD = {"image": torch.zeros(1, 3, H, W), "pose": POSE, "intrinsics": K}
SAMPLE = {"pixels": None, "fraction": None, "seed": 0}


def network_of_zeros():
    return UncertainDepth(nn.Conv2d(3, 1, 1), check_poses=0)


PUBLIC = {
    "UfMStar": (UfMStar, {"config": None, "recalibration": None, "dtype": torch.float32, "device": None}),
    "forward": (
        lambda **k: seen()(**k), GOOD | dict.fromkeys(("aleatoric", "epistemic", "valid")),
    ),
    "mean_uncertainty": (lambda **k: seen().mean_uncertainty(**k), GOOD | SAMPLE),
    "query": (lambda **k: seen().query(**k), {"points": torch.zeros(1, 1, 3)}),
    "reset": (lambda **k: seen().reset(**k), {"streams": None, "keep_evidence": False}),
    "warm_up": (lambda **k: seen().warm_up(**k), {"size": (H, W), "streams": 1, "progress": None}),
    "UncertainDepth": (
        UncertainDepth,
        {"networks": nn.Conv2d(3, 1, 1), "config": None, "mode": "alternate", "posterior": False, "samples": None,
         "anchors": None, "recalibration": None, "check_poses": 0, "multiview_device": None},
    ),
    "UncertainDepth.forward": (
        lambda **k: network_of_zeros()(**k), IMAGE_GOOD | dict.fromkeys(("valid", "anchors")),
    ),
    "update": (
        lambda **k: network_of_zeros().update(**k),
        {"prediction": DepthPrediction(DEPTH), "pose": POSE, "intrinsics": K},
    ),
    "stream": (lambda **k: list(network_of_zeros().stream(**k)), {"frames": []}),
    "with_values": (UfMStarConfig().with_values, {"values": {}}),
    "from_dict": (UfMStarConfig.from_dict, {"values": {}}),
    "from_json": (UfMStarConfig.from_json, {"path": "none"}),
    "resize_intrinsics": (resize_intrinsics, {"intrinsics": K, "old": (4, 4), "new": (8, 8)}),
    "crop_intrinsics": (crop_intrinsics, {"intrinsics": K, "top": 1, "left": 1}),
    "wrap_network": (wrap_network, {"network": nn.Conv2d(3, 1, 1), "inverse": False, "resize": False, "scale": 1.0}),
    "save_checkpoint": (save_checkpoint, {"path": "none/n.pth", "weights": nn.Conv2d(3, 1, 1), "metadata": None}),
    "load_network": (load_network, {"name": "fastdepth", "weights": "none"}),
}  # fmt: skip


@pytest.mark.parametrize("name", PUBLIC)
def test_a_wrong_kind_of_argument_is_named(name, tmp_path, monkeypatch):
    """A value of any kind in place of any argument is used, or refused by an error that names it."""
    monkeypatch.chdir(tmp_path)
    call, arguments = PUBLIC[name]
    for argument in arguments:
        names = {argument, argument.removesuffix("s"), "none", "text", *(["image"] if argument == "networks" else [])}
        for value in () if argument == "progress" else WRONG:
            with ExitStack() as stack:
                stack.push(partial(refused, names, value))
                call(**{**arguments, argument: value})


def refused(names, value, kind, error, _):
    """Suppress an error about an argument that names it."""
    if kind is not None and issubclass(kind, (TypeError, ValueError, IndexError, FileNotFoundError)):
        assert any(name in str(error) for name in names), (names, value, error)
        return True
    return False


class Trainer(nn.Module):
    """As Ultralytics' YOLO: its ``train`` starts a training."""

    def __init__(self):
        super().__init__()
        self.model, self.started = nn.Conv2d(3, 1, 1), False

    def train(self, trainer=None, **_):
        self.started = True

    def forward(self, x):
        return self.model(x)


class Freezes(nn.Module):
    """A network that overrides ``train``, as PyTorch allows, and stays in evaluation mode."""

    def __init__(self):
        super().__init__()
        self.model = nn.Conv2d(3, 1, 1)

    def train(self, mode=True):
        return super().train(False if mode else mode)

    def forward(self, x):
        return self.model(x)


@pytest.mark.parametrize("place", ["alone", "in a list", "inside", "wrapped"])
def test_a_network_whose_train_starts_a_training_is_refused(place):
    network = Trainer()
    call = {
        "alone": lambda: UncertainDepth(network),
        "in a list": lambda: UncertainDepth([nn.Conv2d(3, 1, 1), network]),
        "inside": lambda: UncertainDepth(nn.Sequential(network)),
        "wrapped": lambda: wrap_network(network),
    }[place]
    with pytest.raises(TypeError, match=r"a Trainer,? whose train\(trainer\) is not PyTorch's .*NETWORK.model"):
        call()
    assert not network.started
    UncertainDepth(network.model)
    UncertainDepth(Freezes())


@pytest.mark.parametrize("name", ["depth", "aleatoric", "epistemic", "valid"])
def test_the_mask_of_an_array_is_valid(name):
    """A masked entry is the same as False in ``valid``."""
    masked = np.zeros((1, H, W), bool)
    masked[:, :, W // 2 :] = True
    maps = {name: np.full((1, H, W), value) for name, value in (("depth", 2.0), ("aleatoric", 0.1), ("epistemic", 0.1))}
    maps["valid"] = np.ones((1, H, W), bool)
    expected = UfMStar()(pose=POSE, intrinsics=K, **{**maps, "valid": ~masked})
    out = UfMStar()(pose=POSE, intrinsics=K, **{**maps, name: np.ma.masked_array(maps[name], masked)})
    assert torch.equal(out.valid, expected.valid)
    torch.testing.assert_close(out.variance[out.valid], expected.variance[out.valid], rtol=0, atol=0)
    with pytest.raises(TypeError, match="image must not be masked"):
        network_of_zeros()(np.ma.masked_array(np.zeros((H, W, 3), np.uint8), np.ones((H, W, 3), bool)), POSE, K)


def test_numbers_of_numpy_are_numbers():
    config = UfMStarConfig(max_components=np.int64(100), eta=np.float32(0.5), variances_in_h=np.bool_(False))
    assert config == UfMStarConfig(max_components=100, eta=0.5)
    assert type(config.max_components) is int
    assert seen().query(np.zeros((1, 5, 3))).disagreement.shape == (1, 5)
    sample = UfMStar(CONFIG).mean_uncertainty(DEPTH, POSE, K, pixels=np.int64(7))
    assert sample.total.pixels.tolist() == [7]


def test_poses_far_from_the_origin_need_double_precision_alone():
    assert int(ufm(DEPTH, far(torch.float64), K).statistics.fault[0]) == 0
    assert int(ufm(DEPTH, far(torch.float32, 5e4), K).statistics.fault[0]) == 0
    assert int(ufm(DEPTH, far(torch.float16, 5.0), K).statistics.fault[0]) == 0


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_a_first_image_that_is_black_is_named(caplog, dtype):
    black = torch.zeros(1, 3, H, W, dtype=dtype)
    uncertain = UncertainDepth(Brightness(), CONFIG)
    uncertain(black, POSE, K)
    uncertain(black, POSE, K)
    assert len([text for text in caplog.messages if "the first image is black" in text]) == 1


def test_images_of_half_precision_are_resampled():
    half = torch.rand(1, 3, 20, 30).half()
    resampled = Preprocess(size=(8, 12)).apply_image(half)
    assert resampled.dtype == torch.float16
    torch.testing.assert_close(resampled.float(), Preprocess(size=(8, 12)).apply_image(half.float()), rtol=0, atol=1e-3)


@pytest.mark.parametrize(("call", "error", "message"), REFUSED.values(), ids=REFUSED)
def test_refusals_name_the_argument(call, error, message):
    with pytest.raises(error, match=message):
        call()


POSES_TAKEN = {"array": POSE.numpy(), "3x4": POSE[0, :3], "array 3x4": POSE[:, :3].numpy(), "lists": POSE[0].tolist()}
CAMERAS_TAKEN = {
    "array": K.numpy(), "fx fy cx cy": (FX, FY, CX, CY), "four numbers": torch.tensor([FX, FY, CX, CY], dtype=K.dtype),
    "4x4": K4, "array 4x4": K4[None].numpy(), "lists": K.tolist(),
}  # fmt: skip


@pytest.mark.parametrize(
    ("pose", "intrinsics"),
    [*((pose, K) for pose in POSES_TAKEN.values()), *((POSE, camera) for camera in CAMERAS_TAKEN.values())],
    ids=[*POSES_TAKEN, *CAMERAS_TAKEN],
)
def test_every_form_of_a_camera_is_the_same_camera(pose, intrinsics):
    expected = ufm(DEPTH, POSE, K, DEPTH / 100)
    depth = DEPTH.numpy()
    depth.flags.writeable = False
    got = ufm(depth, pose, intrinsics, DEPTH.numpy() / 100, valid=np.ones((1, H, W), bool))
    assert same(got.variance, expected.variance)
    assert same(got.depth, DEPTH)


def test_whole_numbers_are_intrinsics():
    whole = np.array([[40, 0, 20], [0, 40, 15], [0, 0, 1]])
    assert same(ufm(DEPTH, POSE, whole).variance, ufm(DEPTH, POSE, torch.tensor(whole).double()).variance)


@pytest.mark.parametrize(
    "image",
    [IMAGE[0], PICTURE, PICTURE[None], PICTURE[:, ::-1][:, ::-1], Image.fromarray(PICTURE)],
    ids=["tensor", "array", "batch of arrays", "array of negative strides", "Pillow"],
)
def test_every_form_of_an_image_is_the_same_image(image):
    network = wrap_network(Brightness(), preprocess=Preprocess(size=(H // 2, W // 2)))
    models = [UncertainDepth(network, CONFIG, preprocess=network.preprocess), UncertainDepth(network, CONFIG)]
    expected, got = (m(x, POSE.numpy(), (FX, FY, CX, CY)) for m, x in zip(models, (IMAGE, image), strict=True))
    assert torch.equal(got.depth, expected.depth)
    assert same(got.variance, expected.variance)
    assert torch.equal(got.intrinsics, expected.intrinsics)


def test_arrays_that_a_network_returns_are_tensors():
    class Arrays(nn.Module):
        def forward(self, image):
            return {"depth": 1 + image.mean(1).numpy(), "spread": np.full((1, H, W), 0.1, np.float32)}

    network = wrap_network(Arrays(), "depth", aleatoric="spread", aleatoric_kind="std")
    prediction = network(IMAGE / 255)
    torch.testing.assert_close(prediction.aleatoric_variance, torch.full((1, H, W), 0.01))


@pytest.mark.parametrize("output", [lambda depth: depth[:, None], lambda depth: {"depth": depth.numpy()}])
@pytest.mark.parametrize("kind", ["module", "function", "wrapped"])
def test_every_kind_of_network_is_the_same_network(kind, output):
    """A module or a function receives bytes scaled to [0, 1]; its only output is metric depth, as with
    ``wrap_network``."""

    class Bright(nn.Module):
        def forward(self, image):
            return output(1 + image.mean(1))

    networks = {"module": Bright(), "function": Bright().forward, "wrapped": wrap_network(Bright())}
    got = UncertainDepth(networks[kind], CONFIG)(PICTURE, POSE, K)
    torch.testing.assert_close(got.depth, 1 + IMAGE.float().mean(1) / 255)
    assert torch.equal(got.intrinsics, K[None])


def test_a_posterior_without_a_source_of_anchors_is_dense():
    assert UncertainDepth(Brightness(), posterior=True).landmarks._sources[0].identity["anchors"] == "dense"
    assert UncertainDepth(Brightness(), posterior=True, anchors="corners").landmarks._sources[0].identity != "dense"
    assert UncertainDepth(None, posterior=True).landmarks is None
