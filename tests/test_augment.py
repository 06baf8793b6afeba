"""Augmentation: re-projection of known points, no interpolation of depth, seeds, colours as Pillow's, devices."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image, ImageEnhance
from test_preprocess import blob, centroid, project

import scenes
from ufmstar_torch.train import Augmentation, AugmentationConfig

SIZE = (120, 160)
# Non-square pixels, a principal point far from the centre, and skew, so that no error cancels by symmetry.
K = torch.tensor([[130.0, 0.7, 70.0], [0.0, 141.0, 66.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
SIGMA = 3.0  # [px]
STILL = {"scale": (1.0, 1.0), "rotation": 0.0, "flip": 0.0, "brightness": 0.0, "contrast": 0.0, "saturation": 0.0}

CHANGES = {
    "none": {},
    "flip": {"flip": 1.0},
    "zoom": {"scale": (1.5, 1.5)},
    "roll": {"rotation": 5.0},
    "all": {"scale": (1.2, 1.4), "rotation": 5.0, "flip": 1.0},
}


def changed(image, depth, intrinsics=K, seed=3, **change):  # the seed draws an angle of 4.96 degrees
    """One image [3, H, W] changed, its depth and intrinsics, and the map M of its pixels."""
    torch.manual_seed(seed)
    augmentation = Augmentation(AugmentationConfig(**{**STILL, **change}))
    result = augmentation(image[None], depth[None], intrinsics[None])
    return *(part[0] for part in result), augmentation.transform.transform_matrix[0].double()


def turn_of(M, new_K, zoom):
    """The turn and mirror G of the camera, from M K = K' G, with K' of the unzoomed depth."""
    optics = new_K.clone()
    if zoom == "depth":
        optics[:2, :2] *= M[:2, :2].det().abs().sqrt()
    return torch.linalg.solve(optics, M @ K)


@pytest.mark.parametrize("zoom", ["depth", "focal"])
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
@pytest.mark.parametrize("pixel", [(80.0, 60.0), (65.0, 72.0), (96.0, 48.0)], ids=str)
def test_a_point_is_seen_where_the_new_intrinsics_project_it(pixel, change, zoom):
    """Image, depth and K' of one known 3D point agree; the blob's centre of mass to .02 px."""
    point = torch.linalg.solve(K, torch.tensor([*pixel, 1.0], dtype=torch.float64)) * 2.5
    source = blob(*SIZE, torch.tensor(pixel), torch.full((2,), SIGMA))[0]
    image, new_depth, new_K, M = changed(source, torch.full(SIZE, 2.5, dtype=torch.float64), zoom=zoom, **change)
    G = turn_of(M, new_K, zoom)
    torch.testing.assert_close(G @ G.mT, torch.eye(3, dtype=torch.float64), atol=1e-6, rtol=0)
    torch.testing.assert_close(G[2], torch.eye(3, dtype=torch.float64)[2], atol=1e-6, rtol=0)
    assert (new_K[0, 0] > 0) & (new_K[1, 1] > 0)
    assert new_K[1, 0] == 0
    seen = G @ point
    if zoom == "depth":
        seen[2] /= M[:2, :2].det().abs().sqrt()
    where = project(seen, new_K[None])
    torch.testing.assert_close(centroid(image[None]), where, rtol=0, atol=0.02)
    column, row = where.round().long().tolist()
    assert new_depth[row, column].item() == pytest.approx(seen[2].item(), rel=1e-6)


@pytest.mark.parametrize("zoom", ["depth", "focal"])
def test_a_rendered_room_is_the_room_seen_by_the_rolled_camera(zoom):
    """The augmented depth equals a ray-cast with K' and the rolled pose, except at edges (no flip: a mirrored room is
    another room)."""
    pose = scenes.camera_pose((0.2, 0.0, -0.1), 0.6, 0.1)
    camera = K.clone()
    camera[0, 1], camera[1, 1] = 0.0, camera[0, 0]  # the renderer does not support skew, which a turn would give
    depth = torch.from_numpy(scenes.render(pose, camera.numpy(), *SIZE))
    black = torch.zeros(3, *SIZE, dtype=torch.float64)
    _, new_depth, new_K, M = changed(black, depth, camera, scale=(1.3, 1.3), rotation=5.0, zoom=zoom)
    scale = M[:2, :2].det().sqrt()
    optics = new_K.clone()
    if zoom == "depth":  # the same pixels under a camera for which the points do not move
        optics[:2, :2] *= scale
    roll = np.eye(4)
    roll[:3, :3] = torch.linalg.solve(optics, M @ camera).T.numpy()
    exact = torch.from_numpy(scenes.render(pose @ roll, optics.numpy(), *SIZE))
    expected = exact / scale if zoom == "depth" else exact
    valid = new_depth > 0
    error = (new_depth - expected).abs()[valid] / expected[valid]
    assert valid.float().mean() > 0.95
    assert error.median() < 2e-3
    assert (error < 0.02).float().mean() > 0.93  # the rest are edges, half a pixel wide


def test_depth_is_copied_and_never_mixed():
    depth = torch.where(torch.arange(SIZE[1]) % 7 < 3, 1.0, 4.0).expand(SIZE)
    change = {"scale": (1.37, 1.37), "rotation": 5.0}
    _, new_depth, *_ = changed(torch.zeros(3, *SIZE), depth, zoom="focal", **change)
    assert set(new_depth.unique().tolist()) <= {0.0, 1.0, 4.0}
    assert (new_depth > 0).float().mean() > 0.99
    _, nearer, *_ = changed(torch.zeros(3, *SIZE), depth, zoom="depth", **change)
    torch.testing.assert_close(nearer, new_depth / 1.37)


def test_the_rotation_is_applied_and_its_corners_have_no_depth():
    """The rolled frame differs from the original and has no depth in its corners (FastDepth's code discards its rotated
    image)."""
    image, depth = torch.rand(3, *SIZE, generator=torch.Generator().manual_seed(0)), torch.full(SIZE, 2.0)
    rolled, new_depth, *_ = changed(image, depth, rotation=5.0)
    assert (rolled - image).abs().mean() > 0.1
    assert new_depth[0, 0] == 0
    assert rolled[:, 0, 0].max() == 0
    assert (new_depth[40:80, 50:110] == 2).all()


def test_a_seed_decides_and_every_image_of_a_batch_is_changed_differently():
    image, depth = torch.rand(1, 3, *SIZE).expand(3, -1, -1, -1), torch.rand(1, *SIZE).expand(3, -1, -1) + 1
    augmentation, results = Augmentation(), []
    for seed in (7, 7, 8):
        torch.manual_seed(seed)
        results.append(augmentation(image, depth, K.expand(3, 3, 3)))
    assert all(torch.equal(one, two) for one, two in zip(*results[:2], strict=True))
    assert not torch.equal(results[0][2], results[2][2])
    for part in results[0]:
        assert not torch.equal(part[0], part[1])
        assert not torch.equal(part[1], part[2])
    assert torch.equal(image[0], image[1])  # the batch itself is unchanged


@pytest.mark.parametrize("kind", ["brightness", "contrast", "saturation"])
def test_colour_is_changed_as_pillow_does(kind):
    """Pillow works in bytes and rounds the mean and the grey image: 2 of 255 apart at most."""
    array = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    image = torch.from_numpy(array).permute(2, 0, 1).float() / 255
    torch.manual_seed(1)
    augmentation = Augmentation(AugmentationConfig(**{**STILL, kind: 0.4}))
    new_image, *_ = augmentation(image[None], torch.ones(1, *SIZE), K[None])
    factor = augmentation.transform._params[-1].data[f"{kind}_factor"].item()
    assert abs(factor - 1) > 0.05
    enhance = {"brightness": "Brightness", "contrast": "Contrast", "saturation": "Color"}[kind]
    expected = np.asarray(getattr(ImageEnhance, enhance)(Image.fromarray(array)).enhance(factor))
    assert np.abs(255 * new_image[0].permute(1, 2, 0).numpy() - expected).max() <= 2


def test_a_batch_on_a_device_is_augmented_there():
    """A tensor of the device "meta" has no value to read."""
    batch = (
        torch.rand(2, 3, *SIZE, device="meta"),
        torch.rand(2, *SIZE, device="meta"),
        torch.zeros(2, 3, 3, device="meta"),
    )
    assert [part.device.type for part in Augmentation()(*batch)] == ["meta"] * 3
