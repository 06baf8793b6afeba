"""Command lines from frozen dataclasses: an option for every field, its help from the class's docstring.

The form of an option follows from its field:

- ``positional()``: an argument without a name; a field without a default is a required option;
- ``bool``: a flag, ``--name`` where the default is False, ``--no-name`` where it is True;
- ``tuple[str, ...]``: one or several words;
- a field whose type is a dataclass: a group of options, titled by the first line of that class's docstring;
- ``fields_of(Config, prefix)``: an option for every field of a settings class; its value is a dict.

Every command also takes ``--config FILE`` (YAML or JSON, keys are the fields' names). Unknown names and impossible
values raise errors.
"""

from __future__ import annotations

import re
import types
from argparse import SUPPRESS, Action
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass, replace
from functools import cache, reduce
from operator import or_
from os.path import isfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, Union, get_args, get_origin, get_type_hints

if TYPE_CHECKING:
    from _typeshed import DataclassInstance
    from jsonargparse import ArgumentParser

# Limits of a configuration file; the settings of all commands together are 3 levels deep and have 300 values.
_CONFIG_BYTES, _CONFIG_DEPTH, _CONFIG_VALUES = 1_000_000, 50, 100_000
_HELP_ALL = "--help-all"
T = TypeVar("T", bound="DataclassInstance")


class UsageError(Exception):
    """A mistake of the user; the message is one line with the reason."""


@contextmanager
def usage_errors(*kinds: type[Exception]) -> Iterator[None]:
    """Convert errors of these kinds to :class:`UsageError`."""
    try:
        yield
    except kinds as error:
        raise UsageError(error) from error


@dataclass(frozen=True, kw_only=True)
class MachineOptions:
    """Options of many commands, listed after the command's own options.

    Attributes:
        device: of the networks, cpu, cuda or cuda:N; UfM* runs on the CPU
        threads: number of CPU threads of network and step; default: all cores but one
    """

    device: str = "cpu"
    threads: int | None = None


def positional() -> Any:
    """A field that is a positional argument."""
    return field(metadata={"positional": True})


def option(default: Any = MISSING, **how: Any) -> Any:
    """A field whose option needs more than its type; without a default, the option is required. ``how`` has
    ``choices``: the allowed values; ``least``: the smallest one; ``positive``: True for numbers above 0; ``const``: the
    value of the option without a word after it; ``repeat``: True if repeated options add words instead of replacing
    the earlier ones; ``typed``: True if a configuration file must not set the option, since it allows code to run."""
    return field(default=default, metadata=how)


@dataclass(frozen=True)
class _Fields:
    """The arguments of :func:`fields_of`."""

    config: type
    prefix: str = ""
    without: Sequence[str] = ()
    unset: bool = False
    shown: bool = False


def fields_of(config: type, prefix: str = "", **how: Any) -> Any:
    """A field of type ``dict[str, Any]`` with an option for every field of a settings class, also of nested ones.

    A bool needs its value: ``--ufm.add_aleatoric false``. The fields' metadata ``choices``, ``symbol``, ``unit`` and
    ``range`` are used.

    Args:
        config: the settings class.
        prefix: of the options' names. With a dot (``ufm.``) names keep their underscores, and a configuration file has
            the values below that key.
        how: ``without``: names of fields without an option; ``unset``: True to omit options that are not set, instead
            of using the class's defaults; ``shown``: True to show these defaults in the help.
    """
    return field(default_factory=dict, metadata={"fields_of": _Fields(config, prefix, **how)})


def parse(options: type[T], words: Sequence[str], prog: str) -> T:
    """Parse a command line.

    Args:
        options: a dataclass. Its attribute ``USAGE``, if any, replaces the generated usage line.
        words: arguments without the program's name.
        prog: name of the command, for messages.

    Raises:
        ValueError: an unknown option, a value of the wrong type, or an error of ``options`` itself; one line.
    """
    from jsonargparse import ArgumentError

    full = _HELP_ALL in words
    parser = parser_of(options, prog, full=full)
    words = ["--help"] if full else words
    try:
        values = parser.parse_args(list(words)).as_dict()
    except (ArgumentError, TypeError) as error:  # TypeError: a list where a configuration file should have a mapping
        message, required, names = " ".join(str(error).split()).partition("the following arguments are required: ")
        bare = {"", *(f.name for f in fields(options) if f.metadata.get("positional"))}
        listed = [name if name in bare else f"--{name.replace('_', '-')}" for name in names.split(", ")]
        raise ValueError(f"{message}{required}{', '.join(listed)}") from error
    return _build(options, values)


def reader(options: type[T], prog: str) -> Callable[[Sequence[str]], T]:
    """The function ``read`` of a command, which parses its arguments with :func:`parse`."""
    return lambda words: parse(options, words, prog)


def parser_of(options: type, prog: str, *, full: bool = False) -> ArgumentParser:
    """The parser for a dataclass of options; it raises ``ArgumentError`` instead of ending the program. Options with a
    dot in their name (``--ufm.eta``) are in the help only if ``full``."""
    from jsonargparse import ActionConfigFile, ArgumentParser, DefaultHelpFormatter

    class BoundedConfigFile(ActionConfigFile):
        """Check the size and nesting of a configuration before it is parsed, and the options that it sets."""

        def __call__(self, parser: Any, cfg: Any, values: Any, option_string: Any = None) -> None:
            _require_bounded(values)
            before = {name: cfg.get(name) for name in typed}
            super().__call__(parser, cfg, values, option_string)
            if changed := [name for name in typed if cfg.get(name) != before[name]]:
                name = f"--{changed[0].replace('_', '-')}"
                raise ValueError(f"{name} allows code to run: type it on the command line, not in a --config file")

    class Formatter(DefaultHelpFormatter):
        """Omits the default of a flag, which is the field's value (--no-video: True), and the default None."""

        def _get_help_string(self, action: Action) -> str:
            text: str = action.help or "" if isinstance(action.const, bool) else super()._get_help_string(action)
            unknown = action.default in (None, [])
            return re.sub(r", default: %\(default\)s| \(default: %\(default\)s\)", "", text) if unknown else text

    description, _ = _documentation(options)
    typed = _typed(options)
    usage = getattr(options, "USAGE", None)
    parser = ArgumentParser(
        prog=prog, usage=usage, description=description, exit_on_error=False, formatter_class=Formatter
    )
    parser.add_argument("--config", action=BoundedConfigFile, help="JSON or YAML file with any of these options")
    parser.add_argument("--debug", action="store_true", help="show tracebacks")
    parser.add_argument(_HELP_ALL, action="store_true", help="show every option, those of all settings included")
    _add_options(parser, parser, options, full)
    return parser


def _typed(options: type) -> list[str]:
    """The names of the options that a configuration file must not set, those of groups included."""
    hints = get_type_hints(options)
    names = [f.name for f in fields(options) if f.metadata.get("typed")]
    groups = [f for f in fields(options) if is_dataclass(hints[f.name]) and "fields_of" not in f.metadata]
    return names + [name for f in groups for name in _typed(f.metadata.get("type", hints[f.name]))]


def _require_bounded(config: str) -> None:
    """Check a configuration (a file's name or the text) by YAML's events, which neither recurse nor expand aliases.
    Raises ValueError: too large, nested too deeply, or too many values with its aliases expanded."""
    import yaml

    name, text = "--config", config
    if isfile(config):
        name = f"--config {config}"
        with open(config, "rb") as opened:
            text = opened.read(_CONFIG_BYTES + 1).decode(errors="replace")
    if len(text) > _CONFIG_BYTES:
        raise ValueError(f"{name} is larger than {_CONFIG_BYTES:,} bytes, which no configuration needs")
    values, sizes, open_nodes = 0, dict[str, int](), list[tuple[str | None, int]]()
    with suppress(yaml.YAMLError):  # reported by the parser
        for event in yaml.parse(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
            if isinstance(event, yaml.CollectionStartEvent):
                open_nodes.append((event.anchor, values))
            elif isinstance(event, yaml.CollectionEndEvent):
                anchor, before = open_nodes.pop()
                sizes[anchor or ""] = values - before
            elif isinstance(event, yaml.AliasEvent):  # of an unfinished collection: it would contain itself
                values += sizes.get(event.anchor, _CONFIG_VALUES)
            values += isinstance(event, yaml.NodeEvent)
            if len(open_nodes) > _CONFIG_DEPTH:
                raise ValueError(f"{name} is nested deeper than {_CONFIG_DEPTH} levels")
            if values > _CONFIG_VALUES:
                raise ValueError(f"{name} has more than {_CONFIG_VALUES:,} values with its aliases expanded")


def as_dict(options: Any) -> dict[str, Any]:
    """Options as plain values for JSON: groups merged into one level, tuples as lists, paths as text."""
    plain: dict[str, Any] = {}
    for f in fields(options):
        value = getattr(options, f.name)
        if is_dataclass(value):
            plain |= as_dict(value)
        elif isinstance(value, tuple):
            plain[f.name] = list(value)
        else:
            plain[f.name] = str(value) if isinstance(value, Path) else value
    return plain


def _add_options(parser: ArgumentParser, group: Any, options: type, full: bool) -> None:
    hints, (_, help_) = get_type_hints(options), _documentation(options)
    for f in sorted(fields(options), key=lambda f: f.name not in options.__annotations__):  # what is inherited last
        hint = f.metadata.get("type", hints[f.name])
        if "fields_of" in f.metadata:
            _add_fields(group, f.metadata["fields_of"], full)
        elif is_dataclass(hint) and isinstance(hint, type):
            title = (_documentation(hint)[0] or "").splitlines()[0].rstrip(".")
            _add_options(parser, parser.add_argument_group(title), hint, full)
        else:
            names, how = _form(f, hint)
            group.add_argument(*names, help=help_.get(f.name, ""), **how)


def _form(f: Field[Any], hint: Any) -> tuple[list[str], dict[str, Any]]:
    """The names of an option and the arguments of ``add_argument``."""
    name = f"--{f.name.replace('_', '-')}"
    default = _default(f)
    how: dict[str, Any]
    if hint is bool:
        how = {"action": "store_false" if default else "store_true", "dest": f.name}
        return [f"--no-{name[2:]}" if default else name], how
    kind = hint
    how = {} if default is MISSING else {"default": str(default) if isinstance(default, Path) else default}
    parts = get_args(hint)
    if types.NoneType in parts and default is None:
        kind = reduce(or_, (part for part in parts if part is not types.NoneType))
    if get_origin(kind) is tuple and get_args(kind)[-1] is Ellipsis:
        kind = get_args(kind)[0]
        how |= {"nargs": "+"} | ({} if default in (MISSING, None) else {"default": list(default)})
        if f.metadata.get("repeat"):
            how["action"] = "extend"
    elif "const" in f.metadata:
        how |= {"nargs": "?", "const": f.metadata["const"]}
    how |= {"choices": f.metadata["choices"]} if "choices" in f.metadata else {"type": str if kind is Path else kind}
    if f.metadata.get("positional"):
        return [f.name], how
    return [name], how | ({"required": True} if default is MISSING else {})


def _add_fields(group: Any, spec: _Fields, full: bool) -> None:
    """An option for every field of a settings class, and of the settings classes in it."""
    hints, (_, help_) = get_type_hints(spec.config), _documentation(spec.config)
    for f in fields(spec.config):
        if f.name in spec.without:
            continue
        if (section := _section(hints[f.name])) is not None:
            nested = replace(spec, config=section, prefix=f"{spec.prefix}{f.name}.", without=())
            _add_fields(group, nested, full)
            continue
        parts = get_args(hints[f.name]) if get_origin(hints[f.name]) in (Union, types.UnionType) else (hints[f.name],)
        # Every word is a valid text, so that text is tried last.
        kind = reduce(or_, sorted(dict.fromkeys(parts), key=lambda part: part is str))
        how = {"choices": f.metadata["choices"]} if "choices" in f.metadata else {"type": kind}
        name = spec.prefix + f.name
        default = _default(f)
        shown = f"(default: {default})" if spec.shown and default is not None else ""
        text = " ".join(text for text in (help_.get(f.name), _range(f), shown) if text)
        group.add_argument(
            f"--{name if '.' in name else name.replace('_', '-')}",
            default=None if spec.unset else default,
            help=text if full or "." not in name else SUPPRESS,
            **how,
        )


def _section(hint: Any) -> type | None:
    """The dataclass in the hint of a field, which may be optional."""
    return next((part for part in (hint, *get_args(hint)) if isinstance(part, type) and is_dataclass(part)), None)


def _range(f: Field[Any]) -> str:
    """The paper's symbol, the unit and the range of a field, or "" if its metadata has none."""
    if "range" not in f.metadata:
        return ""
    low, high, open_low = f.metadata["range"]
    end = ")" if f.metadata.get("open_high") else "]"
    return f"{f.metadata['symbol']} [{f.metadata['unit']}], {'(' if open_low else '['}{low:g}, {high:g}{end}"


def _default(f: Field[Any]) -> Any:
    return f.default_factory() if f.default_factory is not MISSING else f.default


def _build(options: type[T], values: Mapping[str, Any]) -> T:
    """The dataclass of parsed values, groups and settings included."""
    hints = get_type_hints(options)
    built: dict[str, Any] = {}
    for f in fields(options):
        hint = f.metadata.get("type", hints[f.name])
        if "fields_of" in f.metadata:
            built[f.name] = _settings(f.metadata["fields_of"], values)
        elif is_dataclass(hint) and isinstance(hint, type):
            built[f.name] = _build(hint, values)
        else:
            value = values[f.name]
            if value is not None and Path in (hint, *get_args(hint)):
                value = Path(value)
            least, name = f.metadata.get("least"), f.name.replace("_", "-")
            if value is not None and least is not None and not value >= least:
                raise ValueError(f"--{name} must be at least {least}, got {value}")
            if value is not None and f.metadata.get("positive") and not value > 0:
                raise ValueError(f"--{name} must be positive, got {value}")
            built[f.name] = tuple(value) if isinstance(value, list) else value
    return options(**built)


def _settings(spec: _Fields, values: Mapping[str, Any]) -> dict[str, Any]:
    """The values of :func:`fields_of`."""
    *path, _ = spec.prefix.split(".")
    for key in path:
        values = values[key]
    settings = {f.name: values.get(f.name) for f in fields(spec.config) if f.name not in spec.without}
    for f in fields(spec.config):
        section = settings.get(f.name)
        if spec.unset and isinstance(section, Mapping):
            settings[f.name] = {name: value for name, value in section.items() if value is not None} or None
    return {name: value for name, value in settings.items() if not (spec.unset and value is None)}


@cache
def _documentation(options: type) -> tuple[str | None, dict[str, str]]:
    """The description in a class's docstring, and the texts of its attributes, inherited ones included."""
    from docstring_parser.google import parse as parse_docstring

    texts: dict[str, str] = {}
    for owner in reversed(options.__mro__[:-1]):
        for attribute in parse_docstring(owner.__doc__ or "").params:
            text = " ".join((attribute.description or "").split())
            texts |= dict.fromkeys((name.strip() for name in attribute.arg_name.split(",")), text)
    return parse_docstring(options.__doc__ or "").description, texts
