"""Augmentation: re-projection of known points, no interpolation of depth, seeds, colour changes equal to Pillow's."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image, ImageEnhance
from test_preprocess import blob, centroid, project
from torch import Tensor

import scenes
from ufmstar_torch.train import Augmentation, AugmentationConfig
from ufmstar_torch.train.augment import Change, apply_colour, apply_geometry

SIZE = (120, 160)
# Non-square pixels, a principal point far from the centre, and skew, so that no error cancels by symmetry.
K = torch.tensor([[130.0, 0.7, 70.0], [0.0, 141.0, 66.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
SIGMA = 3.0  # [px]

CHANGES = {
    "none": Change(),
    "flip": Change(flip=True),
    "zoom": Change(scale=1.5),
    "roll": Change(angle=0.087),
    "rollback": Change(angle=-0.087, flip=True),
    "shift": Change(scale=1.3, shift=(11.0, -7.5)),
    "all": Change(scale=1.4, angle=0.08, flip=True, shift=(-9.25, 6.5)),
}


def seen_by_new_camera(point: Tensor, change: Change, zoom: str) -> Tensor:
    """The point [3] in the augmented camera's frame, computed from the documented steps: roll, mirror, zoom."""
    c, s = np.cos(change.angle), np.sin(change.angle)
    x, y, z = point.tolist()
    x, y = c * x - s * y, s * x + c * y
    if change.flip:
        x = -x
    return torch.tensor([x, y, z / change.scale if zoom == "depth" else z], dtype=torch.float64)


@pytest.mark.parametrize("zoom", ["depth", "focal"])
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
@pytest.mark.parametrize("pixel", [(80.0, 60.0), (65.0, 72.0), (96.0, 48.0)], ids=str)
def test_a_point_is_seen_where_the_new_intrinsics_project_it(pixel, change, zoom):
    """Image, depth and K' of one known 3D point agree; the blob's centre of mass to .02 px."""
    point = torch.linalg.solve(K, torch.tensor([*pixel, 1.0], dtype=torch.float64)) * 2.5
    depth = torch.full(SIZE, 2.5, dtype=torch.float64)
    source = blob(*SIZE, torch.tensor(pixel), torch.full((2,), SIGMA))[0]
    image, new_depth, new_K = apply_geometry(source, depth, K, change, zoom)
    present = seen_by_new_camera(point, change, zoom)
    where = project(present, new_K[None])
    torch.testing.assert_close(centroid(image[None]), where, rtol=0, atol=0.02)
    column, row = where.round().long().tolist()
    assert new_depth[row, column].item() == pytest.approx(present[2].item(), abs=1e-12)


@pytest.mark.parametrize("zoom", ["depth", "focal"])
def test_a_rendered_room_is_the_room_seen_by_the_rolled_camera(zoom):
    """The augmented depth equals a ray-cast with K' and the rolled pose, except at edges (no flip: a mirrored room is
    another room)."""
    pose = scenes.camera_pose((0.2, 0.0, -0.1), 0.6, 0.1)
    change = Change(scale=1.3, angle=0.08, shift=(5.0, 3.0))
    camera = K.clone()
    camera[0, 1] = 0.0  # the renderer does not support skew
    depth = torch.from_numpy(scenes.render(pose, camera.numpy(), *SIZE))
    _, new_depth, new_K = apply_geometry(torch.zeros(3, *SIZE, dtype=torch.float64), depth, camera, change, zoom)
    # The new camera's axes as columns in the old frame: points turn by +angle, so axes turn by -angle.
    roll = np.eye(4)
    cos, sin = np.cos(change.angle), np.sin(change.angle)
    roll[:2, :2] = [[cos, sin], [-sin, cos]]
    optics = new_K.clone()
    if zoom == "depth":  # the same pixels under a camera for which the points do not move
        optics[:2, :2] *= change.scale
    exact = torch.from_numpy(scenes.render(pose @ roll, optics.numpy(), *SIZE))
    expected = exact / change.scale if zoom == "depth" else exact
    valid = new_depth > 0
    error = (new_depth - expected).abs()[valid] / expected[valid]
    assert valid.float().mean() > 0.95
    assert error.median() < 2e-3
    assert (error < 0.02).float().mean() > 0.93  # the rest are edges, half a pixel wide


def test_depth_is_copied_and_never_mixed():
    depth = torch.where(torch.arange(SIZE[1]) % 7 < 3, 1.0, 4.0).expand(SIZE)
    change = Change(scale=1.37, angle=0.08)
    _, new_depth, _ = apply_geometry(torch.zeros(3, *SIZE), depth, K, change, "focal")
    assert set(new_depth.unique().tolist()) == {1.0, 4.0}
    _, nearer, _ = apply_geometry(torch.zeros(3, *SIZE), depth, K, change, "depth")
    torch.testing.assert_close(nearer, new_depth / 1.37)


def test_the_rotation_is_applied_and_its_corners_have_no_depth():
    """The rolled frame differs from the original and has no depth in its corners (FastDepth's code discards its rotated
    image)."""
    image, depth = torch.rand(3, *SIZE, generator=torch.Generator().manual_seed(0)), torch.full(SIZE, 2.0)
    rolled, new_depth, _ = apply_geometry(image, depth, K, Change(angle=0.087))
    assert (rolled - image).abs().mean() > 0.1
    assert new_depth[0, 0] == 0
    assert rolled[:, 0, 0].max() == 0
    assert (new_depth[40:80, 50:110] == 2).all()


def test_seeds_decide_and_the_global_generators_do_not():
    image, depth = torch.rand(3, *SIZE), torch.rand(SIZE) + 1
    augmentation = Augmentation(AugmentationConfig(crop="random"))
    torch.manual_seed(1)
    state = torch.get_rng_state()
    first = augmentation(image, depth, K, (7, 2, 40))
    assert torch.equal(torch.get_rng_state(), state)
    torch.manual_seed(99)
    again = augmentation(image, depth, K, (7, 2, 40))
    for a, b in zip(first, again, strict=True):
        assert torch.equal(a, b)
    for other in [(8, 2, 40), (7, 3, 40), (7, 2, 41), (2, 7, 40)]:
        assert not torch.equal(augmentation(image, depth, K, other)[1], first[1])


@pytest.mark.parametrize("kind", ["brightness", "contrast", "saturation"])
@pytest.mark.parametrize("factor", [0.6, 1.0, 1.4])
def test_colour_is_changed_as_pillow_does(kind, factor):
    """Pillow works in bytes and rounds the mean and the grey image: 2 of 255 apart at most."""
    array = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    enhance = {"brightness": "Brightness", "contrast": "Contrast", "saturation": "Color"}[kind]
    expected = np.asarray(getattr(ImageEnhance, enhance)(Image.fromarray(array)).enhance(factor))
    got = apply_colour(torch.from_numpy(array).permute(2, 0, 1).float() / 255, ((kind, factor),))
    assert np.abs(255 * got.permute(1, 2, 0).numpy() - expected).max() <= 2
