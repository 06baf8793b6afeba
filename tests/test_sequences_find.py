"""Sequences below a root: each exactly once, with names independent of the order on disk."""

from __future__ import annotations

import shutil

import layouts
import pytest

from ufmstar_torch.eval.sequences import find_sequences, open_sequence


def found(root, **options):
    return {one.name: (one.layout, one.path) for one in find_sequences(root, **options)}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A folder with sequences of several layouts, at different depths."""
    root = tmp_path_factory.mktemp("disk")
    layouts.write_tum(root / "tum", frames=1)
    layouts.write_seven_scenes(root / "7scenes" / "chess", frames=1)
    shutil.copytree(root / "7scenes" / "chess" / "seq-01", root / "7scenes" / "chess" / "seq-02")
    layouts.write_scannet(root / "scans", frames=1)
    layouts.write_tartanair(root, frames=1)
    shutil.copytree(root / "office" / "P000", root / "office" / "P001")
    layouts.write_generic(root / "a" / "b", frames=1)
    (root / "notes").mkdir()
    (root / "notes" / "readme.txt").write_text("nothing")
    return root


@pytest.fixture
def root(written, tmp_path):
    """A copy that the test may change."""
    return shutil.copytree(written, tmp_path / "disk")


NAMES = {
    "7scenes__chess__seq-01": "7scenes",
    "7scenes__chess__seq-02": "7scenes",
    "a__b__walk": "generic",
    "office__P000": "tartanair",
    "office__P001": "tartanair",
    "scans__scene0000_00": "scannet",
    "tum__rgbd_dataset_freiburg2_desk": "tum",
}


def test_every_sequence_is_found_once_by_its_place(root):
    assert {name: layout for name, (layout, _) in found(root).items()} == NAMES
    assert [one.name for one in find_sequences(root)] == sorted(NAMES)
    for one in find_sequences(root):
        assert open_sequence(one.path, one.layout).layout == one.layout


def test_a_sequence_itself_is_found(root):
    assert found(root / "a" / "b" / "walk") == {"walk": ("generic", root / "a" / "b" / "walk")}
    assert found(root / "office") == {
        "P000": ("tartanair", root / "office" / "P000"),
        "P001": ("tartanair", root / "office" / "P001"),
    }


def test_links_in_a_circle_end_and_links_do_not_double(root):
    (root / "a" / "again").symlink_to(root)
    (root / "a" / "b" / "walk2").symlink_to(root / "a" / "b" / "walk")
    (root / "0first").symlink_to(root / "scans")
    assert {name: layout for name, (layout, _) in found(root).items()} == NAMES


def test_a_link_to_somewhere_else_counts(root, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    layouts.write_generic(elsewhere, frames=1)
    (root / "linked").symlink_to(elsewhere)
    assert set(found(root)) == {*NAMES, "linked__walk"}


def test_hidden_folders_and_those_of_others_are_left_out(root, monkeypatch):
    shutil.copytree(root / "a" / "b" / "walk", root / ".trash" / "walk")
    shut = root / "lost+found"
    shut.mkdir()
    listing = type(root).iterdir

    def guarded(path):
        if path == shut:  # the user root may read everything, so file modes would have no effect
            raise PermissionError(13, "Permission denied", str(path))
        return listing(path)

    monkeypatch.setattr(type(root), "iterdir", guarded)
    assert set(found(root)) == set(NAMES)


def test_what_cannot_be_searched_is_refused(root, tmp_path):
    with pytest.raises(FileNotFoundError, match="root: no such file or folder"):
        find_sequences(tmp_path / "absent")
    with pytest.raises(ValueError, match="layout must be one of auto, tum"):
        find_sequences(root, layout="kitti")
    shutil.copytree(root / "tum" / "rgbd_dataset_freiburg2_desk", root / "scans" / "scene0000_00", dirs_exist_ok=True)
    with pytest.raises(ValueError, match="scene0000_00 fits the layouts tum, scannet: pass layout"):
        find_sequences(root)
    assert set(found(root, layout="scannet")) == {"scans__scene0000_00"}
