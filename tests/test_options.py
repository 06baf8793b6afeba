"""Command lines from dataclasses: every kind of option, configuration files, help, and refusals."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.commands.options import as_dict, fields_of, option, parse, positional


@dataclass(frozen=True)
class _Output:
    """Folders.

    Attributes:
        out: folder of the results.
        resume: continue.
        video: leave the video out.
    """

    out: Path
    resume: bool = False
    video: bool = True


@dataclass(frozen=True, kw_only=True)
class _Options:
    """Do something with a sequence.

    Attributes:
        sequence: a folder.
        output: see there.
        fps, rate: frames per second, over
            two lines.
        names: some words.
        networks: repeatable.
        sizes: in pixels [px].
        kind: one of two.
        long: frames.
        truth_scale: metres per unit.
    """

    sequence: str = positional()
    output: _Output
    fps: float | None = None
    rate: float = option(30.0, positive=True)
    names: tuple[str, ...] = ()
    networks: tuple[str, ...] = option((), repeat=True)
    sizes: tuple[int, ...] = (224, 518)
    kind: str = option("numba", choices=("numba", "torch"))
    long: int | None = option(None, const=1000, least=2)
    truth_scale: float | None = None
    ufm: dict[str, Any] = fields_of(UfMStarConfig, "ufm.", unset=True, shown=True)
    changes: dict[str, Any] = fields_of(UfMStarConfig, "change.", without=("segment", "backend"), unset=True)


def _parse(line: str) -> _Options:
    return parse(_Options, line.split(), "prog")


def test_defaults_and_required_ones():
    options = _parse("seq --out o")
    assert options.sequence == "seq"
    assert options.output == _Output(Path("o"))
    assert (options.fps, options.names, options.sizes, options.long) == (None, (), (224, 518), None)
    assert (options.ufm, options.changes) == ({}, {})


def test_every_form():
    line = "seq --out o --resume --no-video --fps 25 --names a b --networks c --networks d e --sizes 48 --kind torch"
    options = _parse(
        f"{line} --long --truth-scale .001 --ufm.segment.prune none --ufm.add_aleatoric false --change.eta .2"
    )
    assert options.output == _Output(Path("o"), resume=True, video=False)
    assert (options.fps, options.names, options.networks, options.sizes) == (25.0, ("a", "b"), ("c", "d", "e"), (48,))
    assert (options.kind, options.long, options.truth_scale) == ("torch", 1000, 0.001)
    assert options.ufm["segment"]["prune"] == "none"
    assert options.ufm["add_aleatoric"] is False
    assert options.changes == {"eta": 0.2}
    assert _parse("seq --out o --long 7 --truth-scale 1").long == 7


def test_plain_values_are_flat():
    plain = as_dict(_parse("seq --out o --names a --ufm.eta .5"))
    assert plain["out"] == "o"
    assert plain["names"] == ["a"]
    assert plain["ufm"] == {"eta": 0.5}
    assert "output" not in plain


def test_a_configuration_file(tmp_path):
    file = tmp_path / "options.yaml"
    file.write_text("out: there\nrate: 3\nvideo: false\nnames: [a, b]\nufm:\n  eta: .25\n  segment: {sparse: 3}\n")
    options = _parse(f"seq --config {file} --rate 4")
    assert options.output == _Output(Path("there"), video=False)
    assert (options.rate, options.names, options.ufm["eta"]) == (4.0, ("a", "b"), 0.25)
    assert options.ufm["segment"]["sparse"] == 3


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("seq", "out"),
        ("--out o", "sequence"),
        ("seq --out o --nope", "--nope"),
        ("seq --out o --rate x", "rate"),
        ("seq --out o --rate 0", "--rate must be positive, got 0.0"),
        ("seq --out o --long 1", "--long must be at least 2, got 1"),
        ("seq --out o --kind other", "choose from 'numba', 'torch'"),
        ("seq --out o --ufm.nope 1", "--ufm.nope"),
        ("seq --out o --ufm.segment.sparse x", "sparse"),
        ("seq --out o --config {}", "'nope'"),
        ("seq --out o --config missing.yaml", "missing.yaml"),
    ],
)
def test_what_is_refused(line, reason, tmp_path):
    file = tmp_path / "wrong.yaml"
    file.write_text("nope: 1\n")
    with pytest.raises(ValueError, match=reason) as refused:
        _parse(line.format(file))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("text", ["- a\n", "3\n", "a: [\n"])
def test_a_file_that_is_no_configuration(text, tmp_path):
    file = tmp_path / "wrong.yaml"
    file.write_text(text)
    with pytest.raises(ValueError, match="config") as refused:
        _parse(f"seq --out o --config {file}")
    assert "\n" not in str(refused.value)


_BOMB = "a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 10)
)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("[" * 200_000, "nested deeper than 50 levels"),
        ("out: " + "{a: " * 200_000, "nested deeper than 50 levels"),
        (_BOMB, "more than 100,000 values"),
        ("a: &a [*a]\n", "more than 100,000 values"),
        ("out: " + "x" * 1_000_001, "larger than 1,000,000 bytes"),
    ],
)
def test_a_configuration_has_limits(text, reason, tmp_path):
    file = tmp_path / "bomb.yaml"
    file.write_text(text)
    with pytest.raises(ValueError, match=rf"bomb\.yaml.* {reason}"):
        _parse(f"seq --out o --config {file}")
    with pytest.raises(ValueError, match=reason):
        parse(_Options, ["seq", "--out", "o", "--config", text], "prog")


def test_help_has_the_attributes_texts(capsys):
    with pytest.raises(SystemExit) as ended:
        _parse("--help-all")
    assert ended.value.code == 0
    text = " ".join(capsys.readouterr().out.split())
    for expected in (
        "Do something with a sequence.",
        "Folders: --out",
        "--fps FPS frames per second, over two lines.",
        "--rate RATE frames per second, over two lines.",
        "--no-video leave the video out.",
        "--ufm.variance_floor VARIANCE_FLOOR",
        "v_min [m^2], [0, inf]",
    ):
        assert expected in text
