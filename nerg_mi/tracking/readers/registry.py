"""Registry of readers, and reading files with one of them."""

from __future__ import annotations

import importlib
import os
import pkgutil
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError, parameter
from nerg_mi.tracking.rays import Rays

from . import skeleton, table
from .base import Option, RaysBuilder, Reader, list_options, list_recorded_options

TABLE = table.TABLE.name
"""Name of the reader of tables with a column map. All other readers know their columns, and are called presets."""

_READERS: dict[str, Reader[Any]] = {}
_FORMER_NAMES = {"skeleton22": skeleton.SkeletonFile.name}


def register_reader(reader: Reader[Any]) -> None:
    """Register a reader under its name, for `import_rays` and the command line.

    Raises ``ValueError`` if the name is taken or invalid, or if the flag of an option denotes another field or type of
    another reader: the command line has only one option per flag.
    >>> import nerg_mi as nerg
    >>> from nerg_mi.tracking.readers.hololens import Arett
    >>> from nerg_mi.tracking.readers.registry import list_reader_names, unregister_reader
    >>> class OfOurLab(Arett):
    ...     name = "our_lab"
    >>> nerg.register_reader(OfOurLab())
    >>> "our_lab" in list_reader_names()
    True
    >>> unregister_reader("our_lab")
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]*", reader.name) or reader.name in _READERS:
        raise ValueError(f'a reader cannot be called "{reader.name}": the name is taken, or not a lower-case word')
    options_by_flag = {o.flag: o for r in _READERS.values() for o in list_options(r.Options)}
    for option in (o for o in list_options(reader.Options) if o.flag):
        other = options_by_flag.get(option.flag, option)
        if (other.name, other.kind) != (option.name, option.kind):
            raise ValueError(
                f"{option.flag} of {reader.name} is {option.name} ({option.kind.__name__}), and of other readers "
                f"{other.name} ({other.kind.__name__}); rename it"
            )
    _READERS[reader.name] = reader


def unregister_reader(name: str) -> None:
    """Remove a reader. Raises ``KeyError`` for an unknown name."""
    del _READERS[name]


def list_reader_names() -> tuple[str, ...]:
    """Names of all readers, in order of registration."""
    return tuple(_READERS)


def iterate_readers() -> Iterable[Reader[Any]]:
    """All readers, in order of registration."""
    return _READERS.values()


def list_preset_names() -> tuple[str, ...]:
    """Names of the presets: the readers that know their columns."""
    return tuple(name for name in _READERS if name != TABLE)


def get_reader(name: str) -> Reader[Any]:
    """The reader with this name, or with this former name. Raises `NergError` listing the presets otherwise."""
    name = _FORMER_NAMES.get(name, name)
    if name not in _READERS:
        raise NergError(
            f'there is no preset "{name}"; choose one of {", ".join(list_preset_names())}, or use a column map'
        )
    return _READERS[name]


def make_options(name: str, values: Mapping[str, Any]) -> Any:
    """Make the options of the reader ``name`` from ``values`` by field name; other fields have their defaults.

    Raises `NergError` for options that the reader does not have, and for invalid values.
    """
    reader = get_reader(name)
    names = {o.name for o in list_options(reader.Options)}
    foreign = ", ".join(parameter(key) for key in values if key not in names)
    if foreign and name == TABLE:
        raise NergError(
            f"{foreign} belongs to a preset; leave it out, or use {parameter('preset')} instead of "
            f"{parameter('columns')}"
        )
    if foreign:
        raise NergError(f"preset {name} has fixed conventions; leave out {foreign}")
    return reader.Options(**values)


def parse_options(name: str, values: Mapping[str, Any]) -> Any:
    """As :func:`make_options`, but with ``values`` from the command line, which are text for options with a parser."""
    parse = {o.name: o.parse for o in list_options(get_reader(name).Options)}
    return make_options(name, {key: f(value) if (f := parse.get(key)) else value for key, value in values.items()})


def read_rays(
    reader: str | Reader[Any],
    files: str | os.PathLike | Sequence[str | os.PathLike],
    options: Any = None,
    *,
    skip_bad_lines: bool = False,
    on_source: Callable[[str], None] | None = None,
    on_rays: Callable[[Rays], None] | None = None,
) -> Rays:
    """Read tracking files as rays in the common frame: right-handed, z up, metres, seconds.

    The metadata record the reader, its options, the files, their frame, and the dropped rows.

    Parameters
    ----------
    reader
        A reader, or its name.
    files
        One or more files, or folders of recordings.
    options
        An object of the reader's ``Options``. Default: all defaults.
    skip_bad_lines
        Whether to skip unreadable lines, at most 1 % of a file.
    on_source
        Called with the name of each file when it begins.
    on_rays
        Receives rays block by block, so that memory is bounded for files of any size. The function then returns the
        last rays, possibly none, with the metadata of all.

    Raises
    ------
    NergError
        For files that are not of the format, or give no rays.
    TypeError
        For options of another reader.
    """
    reader = get_reader(reader) if isinstance(reader, str) else reader
    options = reader.Options() if options is None else options
    if not isinstance(options, reader.Options):
        raise TypeError(f"{reader.name} takes {reader.Options.__qualname__}, not {type(options).__qualname__}")
    paths = [Path(p) for p in ([files] if isinstance(files, (str, os.PathLike)) else files)]
    if not paths:
        raise NergError("there are no tracking files to read; list one or more")
    builder = RaysBuilder(
        reader.frame(paths, options), skip_bad_lines=skip_bad_lines, on_source=on_source, on_rays=on_rays
    )
    builder.add_metadata(preset=reader.name, **list_recorded_options(options))
    reader.read(paths, options, builder)
    return builder.build()


@dataclass(frozen=True)
class SharedOption:
    """An option of the command line that belongs to one or more readers."""

    name: str  # of the field in the readers' options
    flag: str  # on the command line
    kind: type  # of the value on the command line
    help: str  # with the readers that have it, and their defaults


def collect_shared_options() -> tuple[SharedOption, ...]:
    """Collect the options of all readers for the command line, those of tables first."""
    order = sorted(_READERS, key=lambda name: name != TABLE)
    options_by_name: dict[str, dict[str, Option]] = {}
    for name in order:
        for option in (o for o in list_options(_READERS[name].Options) if o.flag):
            options_by_name.setdefault(option.name, {})[name] = option
    return tuple(
        SharedOption(name, *_merge_options(options_by_reader)) for name, options_by_reader in options_by_name.items()
    )


def _merge_options(options_by_reader: dict[str, Option]) -> tuple[str, type, str]:
    """Merge an option of several readers: flag, type and help."""
    first = next(iter(options_by_reader.values()))
    texts, defaults = (
        {getattr(o, field): [] for o in options_by_reader.values()} for field in ("help", "default_text")
    )
    for name, option in options_by_reader.items():
        texts[option.help].append(name)
        defaults[option.default_text].append(name)
    # Options of tables apply to files of any kind, and are listed without the name of a reader.
    words = [text if names[0] == TABLE else f"{', '.join(names)}: {text}" for text, names in texts.items()]
    defaults_text = [
        text if i == 0 else f"{', '.join(names)}: {text}" for i, (text, names) in enumerate(defaults.items()) if text
    ]
    return (
        first.flag,
        first.kind,
        " ".join(words) + (f"  [default: {'; '.join(defaults_text)}]" if defaults_text else ""),
    )


def summarise_files(reader: Reader[Any]) -> str:
    """The files of a reader in a few words: the beginning of its phrase."""
    return re.split(r"[:;(]|, (?!and)", reader.files.replace("`", ""))[0].strip()


def format_preset(reader: Reader[Any]) -> str:
    """Describe a reader in Markdown, for the manual: files, options, frame, and what it was tried on."""
    options = "; ".join(
        f"`{o.flag or o.name}`{'' if o.flag else ' (in Python)'}: {o.help[:1].lower()}{o.help[1:].rstrip('.')}"
        + (f" ({o.default_text})" if o.default_text else "")
        for o in list_options(reader.Options)
    )
    parts = [reader.files, options, f"Frame: {reader.frame_description}", f"Evidence: {reader.evidence}"]
    return f"`{reader.name}`: {' '.join(f'{part}.' for part in parts if part)}"


# Each module of this package with ``READERS`` contains readers.
for _name in sorted(module.name for module in pkgutil.iter_modules([os.path.dirname(__file__)])):
    if f"{__package__}.{_name}" != __name__:
        for _reader in getattr(importlib.import_module(f"{__package__}.{_name}"), "READERS", ()):
            register_reader(_reader)
