"""Command lines from frozen dataclasses, parsed by tyro; configuration files; settings as NAME=VALUE.

A field is an option, and its text in the class's docstring the help. A field without a default is required;
``Positional`` marks an argument without a name, ``Repeated`` an option that may be given several times. A field whose
type is a dataclass is a group of options.

Every command also takes ``--config FILE`` (TOML or JSON, keys are the names of options) and ``--debug``.
Unknown names and impossible values raise errors of one line.
"""

from __future__ import annotations

import json
import re
from argparse import ArgumentError, ArgumentParser
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import redirect_stderr, suppress
from dataclasses import dataclass, fields, is_dataclass
from io import StringIO
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

import tyro
from tyro.conf import Positional as Positional
from tyro.conf import UseAppendAction
from tyro.conf import arg as arg

from ufmstar_torch.files.limits import read_settings
from ufmstar_torch.runtime.checked import flat

# Options that allow code to run: a configuration file, which may come from elsewhere, must not set them.
CODE = ("trust_code", "plugin")
_SETTINGS = "set"  # the option with NAME=VALUE, a table in a file
_COMMON = "--config FILE takes options from a TOML or JSON file, --debug shows the traceback of an error."
# The marks that tyro adds to a type.
_POSITIONAL, _APPENDED = (get_args(kind)[1] for kind in (Positional[str], UseAppendAction[str]))
T = TypeVar("T")
# Types of options, with short names in the help and without the defaults False, None and ().
_plain: dict[str, Any] = {"help_behavior_hint": ""}
Flag = Annotated[bool, arg(**_plain)]
Text = Annotated[str | None, arg(metavar="TEXT", **_plain)]
File = Annotated[Path | None, arg(metavar="FILE", **_plain)]
Folder = Annotated[Path | None, arg(metavar="DIR", **_plain)]
Count = Annotated[int | None, arg(metavar="N", **_plain)]
Number = Annotated[float | None, arg(metavar="X", **_plain)]
Texts = Annotated[tuple[str, ...], arg(metavar="TEXT...", **_plain)]
Repeated = Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="TEXT", **_plain)]  # one text each time
Words = Annotated[UseAppendAction[tuple[tuple[str, ...], ...]], arg(metavar="TEXT...", **_plain)]  # or several


def one_of(*names: str) -> Any:
    """The help of an option that has one of these names, or None by default."""
    return arg(metavar=f"{{{','.join(names)}}}", **_plain)


@dataclass(frozen=True, kw_only=True)
class MachineOptions:
    """The machine.

    Attributes:
        device: The networks run on cpu, cuda or cuda:N; UfM* runs on the CPU.
        threads: Use this many CPU threads (default: all cores but one).
    """

    device: str = "cpu"
    threads: Count = None


def parse(options: type[T], words: Sequence[str], prog: str) -> T:
    """Parse a command line.

    Args:
        options: a dataclass. Its attribute ``USAGE``, if any, is shown above the options.
        words: arguments without the program's name.
        prog: name of the command, for messages.

    Raises:
        ValueError: an unknown option, a value of the wrong type, or an error of ``options`` itself; one line.
        OSError: the configuration file cannot be read.
    """
    common = ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    common.add_argument("--config", type=Path)
    common.add_argument("--debug", action="store_true")
    try:
        chosen, rest = common.parse_known_args(list(words))
    except ArgumentError as error:
        raise ValueError(error) from error
    if chosen.config is not None:
        settings, named = _from_file(chosen.config, options)
        typed = {word.partition("=")[0][2:].replace("-", "_") for word in rest if word.startswith("--")}
        rest = [*settings, *rest, *(word for name, value in named.items() if name not in typed for word in value)]
    usage = getattr(options, "USAGE", "")
    description = "\n\n".join(text for text in (_description(options), usage, _COMMON) if text)
    how: dict[str, Any] = {"prog": prog, "description": description}
    flags = (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes)
    message = StringIO()
    try:
        with redirect_stderr(message):
            return tyro.cli(options, args=rest, config=flags, **how)
    except SystemExit as ended:
        if not ended.code:
            raise
        text = _first_lines(message.getvalue())
        raise ValueError(f"{text}{_rarer(text, options)}") from None


def reader(options: type[T], prog: str) -> Callable[[Sequence[str]], T]:
    """The function ``read`` of a command, which parses its arguments with :func:`parse`."""
    return lambda words: parse(options, words, prog)


def as_dict(options: Any) -> dict[str, Any]:
    """Options as plain values for JSON: groups merged into one level, tuples as lists, paths as text."""
    plain: dict[str, Any] = {}
    for f in fields(options):
        value = getattr(options, f.name)
        if is_dataclass(value):
            plain |= as_dict(value)
        elif isinstance(value, tuple):
            plain[f.name] = [word for part in value for word in (part if isinstance(part, tuple) else (part,))]
        else:
            plain[f.name] = str(value) if isinstance(value, Path) else value
    return plain


def joined(words: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """The words of all uses of an option of type ``Words``."""
    return tuple(word for part in words for word in part)


def assigned(words: Sequence[str], option: str = "--set") -> dict[str, Any]:
    """The values of words NAME=VALUE by name: numbers, true, false, null, JSON, or text. Raises ValueError: a word
    without a name."""
    values: dict[str, Any] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not (name and equals):
            raise ValueError(f"{option} must be NAME=VALUE, got {word!r}")
        values[name] = _value(text)
    return values


def require_least(options: Any, **least: float) -> None:
    """Raises ValueError: an option that is set lies below its smallest value."""
    for name, bound in least.items():
        value = getattr(options, name)
        if value is not None and not value >= bound:
            raise ValueError(f"--{name.replace('_', '-')} must be at least {bound}, got {value}")


def require_positive(options: Any, *names: str) -> None:
    """Raises ValueError: one of these options is not above 0."""
    for name in names:
        if not getattr(options, name) > 0:
            raise ValueError(f"--{name.replace('_', '-')} must be positive, got {getattr(options, name)}")


def _value(text: str) -> Any:
    """A number, a value of JSON, or the text."""
    with suppress(ValueError, RecursionError):
        return json.loads(text)
    with suppress(ValueError):  # .4 is no JSON; nan and inf are words
        return float(text) if re.match(r"[-+]?\.?\d", text) else text
    return text


def _from_file(file: Path, options: type) -> tuple[list[str], dict[str, list[str]]]:
    """The words of a configuration file: those of settings, and those of every other option by its name.

    Raises:
        ValueError: the file is too large, no TOML or JSON with a table, has an unknown name or a value of the wrong
            kind, or sets an option that allows code to run.
    """
    try:
        values = read_settings(file)
        if not isinstance(values, dict):
            raise ValueError(f"it must hold a table of options, got {type(values).__name__}")
        values, kinds = {key.replace("-", "_"): value for key, value in values.items()}, dict(_kinds(options))
        if code := [key for key in CODE if values.get(key)]:
            raise ValueError(f"{code[0]} allows code to run: type it on the command line, not in a file")
        if unknown := sorted(values.keys() - kinds.keys()):
            raise ValueError(f"no option is called {', '.join(unknown)}")
        settings = values.pop(_SETTINGS, {})
        if not isinstance(settings, Mapping):
            raise ValueError(f"{_SETTINGS} must be a table of settings, got {settings!r:.60}")
        of_settings = [f"--{_SETTINGS}={key}={_word(value)}" for key, value in flat(settings).items()]
        words = {key: _words(key, value, *kinds[key]) for key, value in values.items() if value not in (None, [])}
        return of_settings, {key: value for key, value in words.items() if value}
    except (ValueError, TypeError) as error:
        raise ValueError(f"--config {file}: {error}") from error


def _words(name: str, value: Any, flag: bool, repeated: bool) -> list[str]:
    """The words of an option with a value of a file. Raises ValueError: it has another kind, or a text in a list would
    be read as an option."""
    option, words = f"--{name.replace('_', '-')}", value if isinstance(value, list) else [value]
    if flag and isinstance(value, bool):
        return [option] if value else []
    if flag or not all(type(word) in (str, int, float) for word in words):
        kind = "true or false" if flag else "a text, a number, or a list of them"
        raise ValueError(f"{name} must be {kind}, got {value!r:.60}")
    if repeated or not isinstance(value, list):
        return [f"{option}={_word(word)}" for word in words]
    if wrong := [word for word in words if isinstance(word, str) and word.startswith("-")]:
        raise ValueError(f"{name}: no text in a list may begin with -, got {wrong[0]!r}")
    return [option, *map(_word, words)]


def _word(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _kinds(options: type) -> Iterator[tuple[str, tuple[bool, bool]]]:
    """The names of a dataclass's options with a name, those of its groups included; whether they have no value, and
    whether they are given once for each value."""
    hints, named = get_type_hints(options), get_type_hints(options, include_extras=True)
    for f in fields(options):
        if is_dataclass(hints[f.name]):
            yield from _kinds(hints[f.name])
        elif _POSITIONAL not in get_args(named[f.name]):
            yield f.name, (hints[f.name] is bool, _APPENDED in get_args(named[f.name]))


def _description(options: type) -> str:
    """The docstring of a class up to its attributes."""
    lines = (options.__doc__ or "").partition("Attributes:")[0].strip().splitlines()
    return "\n".join(line.strip() for line in lines)


def _rarer(text: str, options: type) -> str:
    """The words for an unknown option that is a rarer one of the readers; "" for others."""
    from ufmstar_torch.eval.sequences.options import Options

    unknown = re.match(r"Unrecognized options: --([\w-]+)", text)
    name = unknown[1].replace("-", "_") if unknown else ""
    rarer = "reader" in dict(_kinds(options)) and name in (f.name for f in fields(Options))
    return f"; it is a rarer option of readers: --reader {name}=VALUE" if rarer else ""


def _first_lines(message: str) -> str:
    """The text of tyro's error up to its rule, as one line, without the name of a group. Where the terminal has UTF-8,
    the message stands in a box; elsewhere it follows a title and a rule."""
    boxed = [line for line in message.splitlines() if line.startswith("│")]
    lines = [line.strip("│ ") for line in boxed or message.splitlines()]
    rules = [number for number, line in enumerate(lines) if line and not line.strip("─-")]
    first = 0 if boxed or not rules else rules.pop(0) + 1
    text = " ".join(" ".join(lines[first : rules[0] if rules else None]).split())
    text = re.sub(r"^Error parsing (?!--)\S+: ", "", text)
    names = "(?<=Expected one of \\()'.*'(?=\\))"  # in a random order, and with the default None
    return re.sub(names, lambda found: ", ".join(sorted({*found[0].split(", ")} - {"'None'"})), text)
