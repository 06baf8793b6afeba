"""Command lines from dataclasses: every kind of option, configuration files, help, settings, and refusals."""

from __future__ import annotations

import dataclasses
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from importlib import import_module
from io import StringIO
from pathlib import Path
from typing import Literal, get_type_hints

import pytest

from ufmstar_torch.cli import COMMANDS
from ufmstar_torch.eval.commands.opening import OpeningOptions
from ufmstar_torch.eval.commands.options import (
    CODE,
    Positional,
    Repeated,
    Words,
    as_dict,
    assigned,
    parse,
    require_least,
    require_positive,
)

_MOST_OPTIONS = 320  # of all commands together
_TWO_SCREENS = 120  # lines, in a terminal of 100 columns


@dataclass(frozen=True)
class _Output:
    """Folders.

    Attributes:
        out: Write the results here.
        resume: Continue.
        no_video: Leave the video out.
    """

    out: Path
    resume: bool = False
    no_video: bool = False


@dataclass(frozen=True, kw_only=True)
class _Options:
    """Do something with a sequence.

    Attributes:
        sequence: Read this folder.
        fps: Read frames at this rate, over
            two lines.
        set: Set NAME=VALUE.
    """

    sequence: Positional[str]
    output: _Output
    fps: float | None = None
    rate: float = 30.0
    names: tuple[str, ...] = ()
    networks: Words = ()
    sizes: tuple[int, ...] = (224, 518)
    kind: Literal["numba", "torch"] = "numba"
    long: int | None = None
    trust_code: bool = False
    plugin: tuple[str, ...] = ()
    set: Repeated = ()

    def __post_init__(self) -> None:
        require_least(self, long=2)
        require_positive(self, "rate")


def _parse(line: str) -> _Options:
    return parse(_Options, line.split(), "prog")


def test_defaults_and_required_ones():
    options = _parse("seq --out o")
    assert options.sequence == "seq"
    assert options.output == _Output(Path("o"))
    assert (options.fps, options.names, options.sizes, options.long) == (None, (), (224, 518), None)


def test_every_form():
    line = "seq --out o --resume --no-video --fps 25 --names a b --networks c --networks d e --sizes 48 --kind torch"
    options = _parse(f"{line} --long 7 --set eta=.2 --set prune=none")
    assert options.output == _Output(Path("o"), resume=True, no_video=True)
    assert (options.fps, options.names, options.networks, options.sizes) == (
        25,
        ("a", "b"),
        (("c",), ("d", "e")),
        (48,),
    )
    assert (options.kind, options.long, options.set) == ("torch", 7, ("eta=.2", "prune=none"))
    assert _parse("- --out o --fps -1").fps == -1


def test_plain_values_are_flat():
    plain = as_dict(_parse("seq --out o --names a --networks b c --networks d"))
    assert plain["out"] == "o"
    assert plain["names"] == ["a"]
    assert plain["networks"] == ["b", "c", "d"]
    assert "output" not in plain


def test_settings_are_numbers_words_and_json():
    words = ["a=.4", "b=3", "c=true", "d=null", "e=nan", "f=[224, 160]", "g=none", "h=1e-4", "s.t=-2", "i=a=b"]
    values = assigned(words)
    assert values == {
        "a": 0.4, "b": 3, "c": True, "d": None, "e": "nan", "f": [224, 160], "g": "none", "h": 1e-4, "s.t": -2,
        "i": "a=b",
    }  # fmt: skip
    assert isinstance(values["b"], int)
    for wrong in ("eta", "=3"):
        with pytest.raises(ValueError, match="--set must be NAME=VALUE"):
            assigned([wrong])


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("c.toml", "out = 'there'\nrate = 3\nresume = false\nno-video = true\nnames = ['a', 'b']\nfps = -2.0\n"
                   "networks = ['c', '-d']\n"
                   "[set]\neta = .25\nprune = 'none'\nsegment.sparse = 3\n".replace("= .25", "= 0.25")),
        ("c.json", '{"out": "there", "rate": 3, "no_video": true, "names": ["a", "b"], "fps": -2.0, "long": null,'
                   ' "networks": ["c", "-d"],'
                   ' "set": {"eta": 0.25, "prune": "none", "segment": {"sparse": 3}}}'),
    ],
)  # fmt: skip
def test_a_configuration_file(name, text, tmp_path):
    (tmp_path / name).write_text(text)
    options = _parse(f"seq --config {tmp_path / name} --rate 4 --set eta=.5")
    assert options.output == _Output(Path("there"), no_video=True)
    assert (options.rate, options.names, options.fps) == (4.0, ("a", "b"), -2.0)
    assert as_dict(options)["networks"] == ["c", "-d"]
    assert assigned(options.set) == {"eta": 0.5, "prune": "none", "segment.sparse": 3}


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("seq", "--out"),
        ("--out o", "Missing"),
        ("seq --out o --nope", "--nope"),
        ("seq --out o --rate x", "rate"),
        ("seq --out o --rate 0", "--rate must be positive, got 0.0"),
        ("seq --out o --long 1", "--long must be at least 2, got 1"),
        ("seq --out o --kind other", "'numba', 'torch'"),
        ("seq --out o --config", "expected one argument"),
    ],
)
def test_what_is_refused(line, reason):
    with pytest.raises(ValueError, match=reason) as refused:
        _parse(line)
    assert "\n" not in str(refused.value)
    assert "│" not in str(refused.value)


def test_a_missing_configuration_file():
    with pytest.raises(FileNotFoundError, match=r"missing\.json"):
        _parse("seq --out o --config missing.json")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("[1]", "must hold a table of options"),
        ("3", "must hold a table of options"),
        ("{", "neither TOML"),
        ("{" + '"a":' * 100_000, "neither TOML"),
        ("[" * 100_000, "neither TOML"),
        ('{"out": "' + "x" * 1_000_001, "larger than 1,000,000 bytes"),
        ('{"nope": 1}', "no option is called nope"),
        ('{"nope": false}', "no option is called nope"),
        ('{"sequence": "a"}', "no option is called sequence"),
        ('{"set": 3}', "set must be a table"),
        ('{"trust_code": true}', "trust_code allows code to run"),
        ('{"trust-code": true}', "trust_code allows code to run"),
        ('{"plugin": ["a.py"]}', "plugin allows code to run"),
        ('{"resume": "--trust-code"}', "resume must be true or false, got '--trust-code'"),
        ('{"no-video": 1}', "no_video must be true or false, got 1"),
        ('{"fps": true}', "fps must be a text, a number, or a list of them, got True"),
        ('{"names": [["a"]]}', "names must be a text, a number, or a list of them"),
        ('{"names": {"a": 1}}', "names must be a text, a number, or a list of them"),
        ('{"rate": 0}', "--rate must be positive, got 0.0"),
        ('{"names": "a --trust-code"}', None),
    ],
)
def test_a_file_that_is_refused(text, reason, tmp_path):
    file = tmp_path / "c.json"
    file.write_text(text)
    if reason is None:  # a value is one word, whatever it contains
        assert _parse(f"seq --out o --config {file}").names == ("a --trust-code",)
        return
    with pytest.raises(ValueError, match=reason) as refused:
        _parse(f"seq --out o --config {file}")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_a_configuration_file_as_editors_and_shells_write_it(encoding, tmp_path):
    (tmp_path / "C.TOML").write_text("out = 'ü'\r\n", encoding=encoding)
    assert _parse(f"seq --config {tmp_path / 'C.TOML'}").output.out == Path("ü")


def test_a_value_that_no_option_can_have(tmp_path):
    for text in ("fps = 1979-05-27", "set.eta = 1979-05-27", "out = 1\nout = 2", "rate = 9" + 5000 * "9"):
        (tmp_path / "c.toml").write_text(text)
        with pytest.raises(ValueError, match=r"^--config .*c\.toml: "):
            _parse(f"seq --out o --config {tmp_path / 'c.toml'}")


def test_a_value_of_a_file_is_no_option(tmp_path):
    file = tmp_path / "c.json"
    file.write_text('{"names": ["a", "--trust-code"], "fps": 3}')
    with pytest.raises(ValueError, match="names"):
        _parse(f"seq --out o --config {file}")


def test_rarer_options_of_readers():
    opening = OpeningOptions(reader=("drive=3", "topics=/a,/b", "max_truth=4"), intrinsics=("1", "2", "3", "4"))
    assert {name: value for name, value in opening.changed().items() if name != "intrinsics"} == {
        "drive": 3,
        "topics": ("/a", "/b"),
        "max_truth": 4,
    }
    for wrong, reason in (
        ("plugin=a.py", "--reader has no plugin"),
        ("fps=3", "no fps"),
        ("max_truth=-1", "max_truth"),
        ("max_truth=[]", "max_truth must be a number or None, got list"),
        ("max_pose_gap=true", "max_pose_gap must be a number, got bool"),
        ("scans=1.5", "scans must be a whole number or None, got float"),
        ("model_index=a", "model_index must be a whole number or None, got str"),
        ("drive=[1]", "drive must be text or a whole number"),
        ("T_color_depth=[[1]]", "T_color_depth must be a NumPy array or text"),
        ("depth_intrinsics=5", "no such file: 5"),
    ):
        with pytest.raises(ValueError, match=reason):
            OpeningOptions(reader=(wrong,))
    words = ["check", "walk", "--max-pose-gap", ".3"]
    with pytest.raises(ValueError, match=r"--max-pose-gap, \.3; it is a rarer option .*: --reader max_pose_gap=VALUE$"):
        parse(_options_of("data"), words, "ufmstar data")
    with pytest.raises(ValueError, match=r"^Unrecognized options: --anything$"):
        parse(_options_of("data"), ["check", "walk", "--anything"], "ufmstar data")


def _options_of(command: str) -> type:
    """The dataclass of a command's options."""
    module = import_module(f"ufmstar_torch.{COMMANDS[command][0]}")
    own = [kind for kind in vars(module).values() if dataclasses.is_dataclass(kind) and hasattr(kind, "__mro__")]
    names = {"eval": "EvalOptions", "data": "CheckOptions"}
    expected = names.get(command, f"{command.capitalize()}Options")
    return next(kind for kind in own if kind.__name__ == expected)


def _slots(options: type) -> list[str]:
    hints = get_type_hints(options)
    slots = []
    for f in dataclasses.fields(options):
        slots += _slots(hints[f.name]) if dataclasses.is_dataclass(hints[f.name]) else [f.name]
    return slots


def test_commands_have_few_options():
    assert sum(len(_slots(_options_of(command))) for command in COMMANDS) <= _MOST_OPTIONS


@pytest.mark.parametrize("command", COMMANDS)
def test_help_is_short_and_has_sentences(command, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    options, shown = _options_of(command), StringIO()
    with redirect_stdout(shown), pytest.raises(SystemExit) as ended:
        parse(options, ["--help"], f"ufmstar {command}")
    assert ended.value.code == 0
    assert len(shown.getvalue().splitlines()) <= _TWO_SCREENS
    assert "None" not in shown.getvalue(), "no name to choose, and no default to know"
    assert "options options" not in shown.getvalue().replace("-options", "options")
    for name, text in _texts(options).items():
        assert text, name
        assert text[0].isupper(), f"{name}: {text}"
        assert text.endswith("."), f"{name}: {text}"


def _texts(options: type) -> dict[str, str]:
    """The help text of every option, from the docstrings."""
    from docstring_parser.google import parse as parse_docstring

    texts = dict.fromkeys(_slots(options), "")
    groups = [hint for hint in get_type_hints(options).values() if dataclasses.is_dataclass(hint)]
    for owner in [*reversed(options.__mro__[:-1]), *(base for group in groups for base in group.__mro__[:-1][::-1])]:
        for attribute in parse_docstring(owner.__doc__ or "").params:
            if attribute.arg_name in texts:
                texts[attribute.arg_name] = " ".join((attribute.description or "").split())
    return texts


@pytest.mark.parametrize("command", COMMANDS)
def test_no_file_allows_code_to_run(command, tmp_path):
    for name in set(CODE) & set(_slots(_options_of(command))):
        file = tmp_path / f"{name}.json"
        file.write_text(f'{{"{name}": true}}')
        with pytest.raises(ValueError, match="allows code to run"):
            parse(_options_of(command), ["--config", str(file)], "prog")


def test_help_has_the_attributes_texts(capsys):
    with pytest.raises(SystemExit) as ended:
        _parse("--help")
    assert ended.value.code == 0
    text = " ".join(capsys.readouterr().out.replace("│", "").split())
    for expected in ("Do something with a sequence.", "Read frames at this rate, over two lines.", "--config FILE"):
        assert expected in text


def test_a_field_without_default_in_a_group():
    @dataclass(frozen=True)
    class Grouped:
        """Grouped."""

        output: _Output = field(default_factory=lambda: _Output(Path("d")))

    assert parse(Grouped, [], "prog").output.out == Path("d")
