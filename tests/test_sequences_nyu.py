"""NYU's h5 files as single images for the evaluation of networks: no poses, known intrinsics, counts of broken
files."""

from __future__ import annotations

import numpy as np
import pytest
from layouts import truncate
from layouts_more import write_h5, write_nyu
from tiny_suite import evaluate

from ufmstar_torch.eval.commands.run import job_from, read
from ufmstar_torch.eval.engine.evaluate import SequenceError
from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.sequences import find_sequences, open_sequence

NAMES = ("kitchen_1__9", "kitchen_1__10", "office_2__11", "office_2__12")


@pytest.fixture
def written(tmp_path):
    return write_nyu(tmp_path / "nyudepthv2")


def test_frames_and_that_they_have_no_poses(written):
    root, truth = written
    sequence = open_sequence(root)
    assert (sequence.layout, sequence.name, sequence.posed) == ("nyu", "nyu_val", False)
    assert sequence.names == NAMES
    np.testing.assert_allclose(sequence.intrinsics, truth.K, rtol=1e-12)
    for i, frame in enumerate(sequence):
        np.testing.assert_array_equal(frame.image, truth.images[i])
        np.testing.assert_allclose(frame.depth, truth.depths[i], rtol=1e-6)
        np.testing.assert_array_equal(frame.T_world_cam, np.eye(4))


def test_parts_and_scenes(written):
    root, _ = written
    assert open_sequence(root / "val").names == NAMES
    assert open_sequence(root / "val" / "office_2").names == NAMES[2:]
    assert open_sequence(root / "val" / "office_2").name == "nyu_val_office_2"
    assert open_sequence(root / "train").names == ("den__1",)
    result = find_sequences(root.parent)  # one set, not one per scene, and not the training part
    assert [(one.name, one.layout, one.path) for one in result] == [("nyudepthv2__val", "nyu", root / "val")]


def test_holes_are_no_depth(written):
    root, _ = written
    depth = np.full((48, 64), 2.0, np.float32)
    depth[0, :4] = [np.nan, np.inf, -1, 0]
    write_h5(root / "val" / "kitchen_1" / "9.h5", np.zeros((3, 48, 64), np.uint8), depth)
    assert open_sequence(root)[0].depth[0, :5].tolist() == [0, 0, 0, 0, 2]


def test_broken_files_are_counted(written):
    root, _ = written
    val = root / "val"
    truncate(val / "kitchen_1" / "9.h5")
    write_h5(val / "kitchen_1" / "10.h5", np.zeros((3, 24, 32), np.uint8), None)
    write_h5(val / "office_2" / "11.h5", np.zeros((3, 24, 32), np.uint8), np.ones((24, 32), np.float32))
    sequence, errors = open_sequence(root), []
    assert sequence.image_size == (24, 32)  # of the first readable file
    assert [frame.name for frame in sequence.readable(errors.append)] == ["office_2__11"]
    for error, message in zip(
        errors, ("cannot be read", "no dataset 'depth'", "is 64x48, the sequence's"), strict=True
    ):
        assert message in str(error)
    with pytest.raises(ValueError, match="kitchen_1 holds no h5 file that can be read"):
        open_sequence(val / "kitchen_1")


def test_cropped_images_need_intrinsics(tmp_path):
    root, _ = write_nyu(tmp_path, scenes=("a",), frames=1, size=(48, 48))
    with pytest.raises(ValueError, match="these are 48x48, which is not only a resize: pass intrinsics"):
        open_sequence(root)
    assert open_sequence(root, intrinsics=(40, 40, 24, 24)).intrinsics[0, 0] == 40


def test_a_trajectory_or_another_convention_is_refused(written):
    with pytest.raises(ValueError, match="layout 'nyu' takes no trajectory"):
        open_sequence(written[0], trajectory="x.txt")
    with pytest.raises(ValueError, match="'nyu_val' has no poses to convert"):
        open_sequence(written[0], poses="world-to-camera")


def test_a_run_that_compares_views_refuses_it(written, tmp_path):
    words = [str(written[0]), "--depth", "ground-truth", "--out", str(tmp_path / "out")]
    with pytest.raises(ValueError, match="single images without poses, which UfM\\* needs"):
        job_from(read(words), words[0])


def test_an_evaluation_refuses_rows_that_compare_views(written):
    rows = [Row(Method.parse(name)) for name in ("Aleatoric", "UfM*-Aleatoric")]
    with pytest.raises(SequenceError, match=r"single images without poses, on which UfM\*-Aleatoric cannot compare"):
        evaluate(open_sequence(written[0]), rows, {"aleatoric": None})
