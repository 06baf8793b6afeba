"""Weights in files: round trips, prefixes, strictness, damage, and atomic writing."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from ufmstar_torch.models import CheckpointError, load_state_dict_file, save_checkpoint
from ufmstar_torch.models.checkpoints import fill

FORMATS = ["w.pth", "w.pt", "w.safetensors"]


class Small(nn.Module):
    """A module with parameters, a buffer and an integer."""

    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Conv2d(3, 2, 3)
        self.norm = nn.BatchNorm2d(2)


def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return set(a) == set(b) and all(torch.equal(a[k], b[k]) and a[k].dtype == b[k].dtype for k in a)


@pytest.mark.parametrize("name", FORMATS)
def test_round_trip(tmp_path: Path, name: str) -> None:
    source = Small()
    source.norm.num_batches_tracked.add_(7)  # type: ignore[union-attr]
    save_checkpoint(tmp_path / name, source, {"widths": [3, 2]})
    assert same(load_state_dict_file(tmp_path / name), source.state_dict())
    assert [p.name for p in tmp_path.iterdir()] == [name]  # no temporary file remains


def test_other_programs_read_weights_and_metadata(tmp_path: Path) -> None:
    source, metadata = Small(), {"widths": [3, 2]}
    save_checkpoint(tmp_path / "w.pth", source, metadata)
    content = torch.load(tmp_path / "w.pth", weights_only=True)
    assert content["metadata"] == metadata
    assert same(content["state_dict"], source.state_dict())
    save_checkpoint(tmp_path / "w.safetensors", source, metadata)
    assert same(load_file(tmp_path / "w.safetensors"), source.state_dict())
    with safe_open(tmp_path / "w.safetensors", "pt") as file:
        assert file.metadata() == {"metadata": '{"widths": [3, 2]}'}


@pytest.mark.parametrize(
    "wrap",
    [
        lambda s: s,
        lambda s: {"state_dict": s, "epoch": 3},
        lambda s: {"model": s, "optimizer": {"lr": 1.0}},
        lambda s: {"model_state_dict": s},
        lambda s: {f"module.{k}": v for k, v in s.items()},
        lambda s: {"state_dict": {f"model.module.{k}": v for k, v in s.items()}},
        lambda s: {f"_orig_mod.{k}": v for k, v in s.items()},
        lambda s: {f"state_dict.{k}": v for k, v in s.items()},
    ],
    ids=["plain", "state_dict", "model", "model_state_dict", "ddp", "lightning", "compiled", "prefix"],
)
@pytest.mark.parametrize("new", [True, False])
def test_what_wrappers_add_is_taken_off(tmp_path: Path, wrap: Callable[[dict[str, Tensor]], Any], new: bool) -> None:
    """For torch's current format and for the format before 1.6."""
    source = Small()
    torch.save(wrap(dict(source.state_dict())), tmp_path / "w.pth", _use_new_zipfile_serialization=new)
    assert same(load_state_dict_file(tmp_path / "w.pth"), source.state_dict())


def test_everything_that_does_not_fit_is_named_and_nothing_is_loaded(tmp_path: Path) -> None:
    state = dict(Small().state_dict())
    del state["conv.bias"]
    state["head.weight"] = torch.zeros(1)
    state["norm.weight"] = torch.zeros(5)
    state["norm.bias"] = torch.tensor([0.0, torch.nan])
    target = Small()
    before = {k: v.clone() for k, v in target.state_dict().items()}
    with pytest.raises(CheckpointError) as error:
        fill(target, state, "w.pth")
    text = str(error.value)
    assert "w.pth does not fit Small (7 keys)" in text
    assert "1 missing: conv.bias" in text
    assert "1 unexpected: head.weight" in text
    assert "1 of another shape: norm.weight is (5,), expected (2,)" in text
    assert "1 with NaN or infinity: norm.bias" in text
    assert same(target.state_dict(), before)


def test_metadata_nested_too_deeply_names_the_file(tmp_path: Path) -> None:
    save_file({"a": torch.ones(1)}, tmp_path / "deep.safetensors", metadata={"metadata": "[" * 200_000})
    with pytest.raises(CheckpointError, match=r"deep\.safetensors"):
        load_state_dict_file(tmp_path / "deep.safetensors")


@pytest.mark.parametrize("name", FORMATS)
@given(data=st.data())
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_cut_off_files_are_named(tmp_path: Path, name: str, data: st.DataObject) -> None:
    """A file truncated at any byte: the error names the file."""
    save_checkpoint(tmp_path / name, Small())
    whole = (tmp_path / name).read_bytes()
    broken = tmp_path / f"broken_{name}"
    broken.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1), label="bytes kept")])
    with pytest.raises(CheckpointError, match=f"broken_{name}"):
        load_state_dict_file(broken)


@pytest.mark.parametrize("name", FORMATS)
@given(content=st.binary(max_size=300))
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_arbitrary_bytes_are_named(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(CheckpointError, match=name):
        load_state_dict_file(tmp_path / name)


# From torch itself: its error message, tested here, evaluates a deprecated storage class.
@pytest.mark.filterwarnings("ignore:TypedStorage is deprecated:UserWarning")
@pytest.mark.filterwarnings("ignore:Detected pickle protocol:UserWarning")
@example(position=852, value=0, length=880)
@given(position=st.integers(0, 2000), value=st.integers(0, 255), length=st.integers(16, 3000))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damage_to_the_format_of_old_releases(tmp_path: Path, position: int, value: int, length: int) -> None:
    """Before torch 1.6 a file was one pickle. A damaged file loads with other values, or the error names it."""
    path = tmp_path / "old.pth"
    torch.save(Small().state_dict(), path, _use_new_zipfile_serialization=False)
    content = bytearray(path.read_bytes())
    content[position % len(content)] = value
    path.write_bytes(content[:length])
    message = ""
    try:
        load_state_dict_file(path)
    except CheckpointError as error:
        message = str(error)
    assert not message or "old.pth" in message


class Malice:
    """Unpickling it would run code."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (os.environ["UFMSTAR_TEST_TRAP"],)


def test_pickled_objects_are_refused_and_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trap = tmp_path / "trap"
    monkeypatch.setenv("UFMSTAR_TEST_TRAP", str(trap))
    torch.save({"state_dict": Malice()}, tmp_path / "evil.pth")
    torch.save(nn.Linear(2, 2), tmp_path / "module.pth.tar")
    for name in ("evil.pth", "module.pth.tar"):
        with pytest.raises(CheckpointError, match=f"{name} .*pickled Python objects"):
            load_state_dict_file(tmp_path / name)
    assert not trap.exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, "holds no weights, but dict"),
        ([1, 2], "holds no weights, but list"),
        (torch.zeros(3), "holds no weights, but Tensor"),
        ({"a": torch.zeros(1), "epoch": 3}, "more than named tensors: epoch"),
        ({3: torch.zeros(1)}, "more than named tensors: 3"),
    ],
)
def test_files_of_something_else(tmp_path: Path, content: object, message: str) -> None:
    torch.save(content, tmp_path / "w.pth")
    with pytest.raises(CheckpointError, match=message):
        load_state_dict_file(tmp_path / "w.pth")


def test_missing_files_and_unknown_suffixes(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.pth"):
        load_state_dict_file(tmp_path / "none.pth")
    (tmp_path / "w.h5").write_bytes(b"x")
    with pytest.raises(CheckpointError, match=r"w\.h5 must end in \.safetensors or one of \.pth"):
        load_state_dict_file(tmp_path / "w.h5")
    with pytest.raises(CheckpointError, match=r"w\.npz must end in"):
        save_checkpoint(tmp_path / "w.npz", Small())
    assert not (tmp_path / "w.npz").exists()


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If the disk is full at the end of writing, the old weights remain, and no other file."""
    old, name = Small(), FORMATS[0]
    save_checkpoint(tmp_path / name, old)

    def full_disk(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="No space left"):
        save_checkpoint(tmp_path / name, Small())
    assert [p.name for p in tmp_path.iterdir()] == [name]
    assert same(load_state_dict_file(tmp_path / name), old.state_dict())
