"""Which readers there are, and reading files with one of them."""

from __future__ import annotations

import importlib
import os
import pkgutil
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError
from nerg_mi.rays.rays import Rays

from . import skeleton, table
from .base import Option, RaysBuilder, Reader, list_options, recorded_options

TABLE = table.TABLE.name
"""The reader of tables through a column map; the others know their columns, and are the presets."""

_READERS: dict[str, Reader[Any]] = {}
_FORMER_NAMES = {"skeleton22": skeleton.SkeletonFile.name}


def register_reader(reader: Reader[Any]) -> None:
    """Make ``reader`` known by its name, to `import_rays` and to the command line.

    Raises ``ValueError`` for a name that is taken or is no word, or for an option whose flag stands for another field
    or type with another reader: on the command line it is one option for all.

    >>> import nerg_mi as nerg
    >>> from nerg_mi.rays.readers.hololens import Arett
    >>> from nerg_mi.rays.readers.registry import reader_names, unregister
    >>> class OfOurLab(Arett):
    ...     name = "our_lab"
    >>> nerg.register_reader(OfOurLab())
    >>> "our_lab" in reader_names()
    True
    >>> unregister("our_lab")
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]*", reader.name) or reader.name in _READERS:
        raise ValueError(f'a reader cannot be called "{reader.name}": the name is taken, or no word in lower case')
    known = {o.flag: o for r in _READERS.values() for o in list_options(r.Options)}
    for option in list_options(reader.Options):
        other = known.get(option.flag, option)
        if (other.name, other.kind) != (option.name, option.kind):
            raise ValueError(
                f"{option.flag} of {reader.name} is {option.name} ({option.kind.__name__}), and of other readers "
                f"{other.name} ({other.kind.__name__}); rename it"
            )
    _READERS[reader.name] = reader


def unregister_reader(name: str) -> None:
    """Forget a reader. Raises ``KeyError`` where there is none of this name."""
    del _READERS[name]


def list_reader_names() -> tuple[str, ...]:
    """Names of all readers, in the order in which they were registered."""
    return tuple(_READERS)


def readers() -> Iterable[Reader[Any]]:
    """All readers, in the order in which they were registered."""
    return _READERS.values()


def list_preset_names() -> tuple[str, ...]:
    """Names of the readers that know their columns."""
    return tuple(name for name in _READERS if name != TABLE)


def get_reader(name: str) -> Reader[Any]:
    """The reader of this name, or of one that it had. Raises `NergError` naming those there are."""
    name = _FORMER_NAMES.get(name, name)
    if name not in _READERS:
        raise NergError(f'there is no preset "{name}"; choose one of {", ".join(list_preset_names())}, or give a column map')
    return _READERS[name]


def make_options(name: str, given: Mapping[str, Any]) -> Any:
    """The options of the reader ``name`` with the values ``given`` by the fields' names; defaults for the others.

    Raises `NergError` for an option that the reader does not have, naming its flag, or a value that it refuses.
    """
    reader = get_reader(name)
    known, flags = {o.name for o in list_options(reader.Options)}, {o.name: o.flag for o in collect_shared_options()}
    foreign = ", ".join(flags.get(key, key) for key in given if key not in known)
    if foreign and name == TABLE:
        raise NergError(f"{foreign} belongs to a preset; leave it out, or give --preset in place of --map")
    if foreign:
        raise NergError(f"preset {name} knows its own conventions; leave out {foreign}")
    return reader.Options(**given)


def parse_options(name: str, given: Mapping[str, Any]) -> Any:
    """As :func:`make_options`, of values as the command line has them: texts where an option makes its value of one."""
    parse = {o.name: o.parse for o in list_options(get_reader(name).Options)}
    return make_options(name, {key: f(value) if (f := parse.get(key)) else value for key, value in given.items()})


def read_rays(
    reader: str | Reader[Any],
    files: str | os.PathLike | Sequence[str | os.PathLike],
    options: Any = None,
    *,
    skip_bad_lines: bool = False,
    on_source: Callable[[str], None] | None = None,
    on_rays: Callable[[Rays], None] | None = None,
) -> Rays:
    """The rays of ``files``, right-handed, z up, in metres and seconds, with the account of what was dropped.

    ``reader``: one, or its name. ``options``: an object of its ``Options`` (default: all as they are by default).
    ``skip_bad_lines``: leave out lines that cannot be read, at most 1 % of a file's. ``on_source``: called with the
    name of each file as it is begun. ``on_rays``: takes rays block by block as they are read, so that files of any size
    are read in bounded memory; returned are the last of them, maybe none. The metadata are those of all: they say by
    which reader, with which options, from which files and frame the rays were made.

    Raises `NergError` for files that are not of the format, or give no ray; ``TypeError`` for options of another
    reader.
    """
    reader = get_reader(reader) if isinstance(reader, str) else reader
    options = reader.Options() if options is None else options
    if not isinstance(options, reader.Options):
        raise TypeError(f"{reader.name} takes {reader.Options.__qualname__}, not {type(options).__qualname__}")
    paths = [Path(p) for p in ([files] if isinstance(files, (str, os.PathLike)) else files)]
    if not paths:
        raise NergError("there are no tracking files to read; name one or more")
    builder = RaysBuilder(
        reader.frame(paths, options), skip_bad_lines=skip_bad_lines, on_source=on_source, on_rays=on_rays
    )
    builder.note(preset=reader.name, **recorded_options(options))
    reader.read(paths, options, builder)
    return builder.build()


@dataclass(frozen=True)
class SharedOption:
    """An option of the command line: that of one reader, or one that several have in common."""

    name: str  # of the field in the readers' options
    flag: str  # on the command line
    kind: type  # of the value on the command line
    help: str  # with the readers it belongs to and their defaults


def collect_shared_options() -> tuple[SharedOption, ...]:
    """The options of all readers, those of tables first, as the command line has them."""
    order = sorted(_READERS, key=lambda name: name != TABLE)
    found: dict[str, dict[str, Option]] = {}
    for name in order:
        for option in list_options(_READERS[name].Options):
            found.setdefault(option.name, {})[name] = option
    return tuple(SharedOption(name, *_shared(of)) for name, of in found.items())


def _shared(of: dict[str, Option]) -> tuple[str, type, str]:
    """Flag, type and help of an option by the readers that have it."""
    first = next(iter(of.values()))
    texts, defaults = ({getattr(o, of_what): [] for o in of.values()} for of_what in ("help", "shown"))
    for name, option in of.items():
        texts[option.help].append(name)
        defaults[option.shown].append(name)
    # What tables know is there for files of any kind, and said without a name.
    words = [text if names[0] == TABLE else f"{', '.join(names)}: {text}" for text, names in texts.items()]
    shown = [
        text if i == 0 else f"{', '.join(names)}: {text}" for i, (text, names) in enumerate(defaults.items()) if text
    ]
    return first.flag, first.kind, " ".join(words) + (f"  [default: {'; '.join(shown)}]" if shown else "")


def format_preset_table() -> str:
    """The readers that know their columns as a table in Markdown, for the manual."""
    rows = ["| preset | files | frame | checked on |", "|---|---|---|---|"]
    for reader in map(get_reader, list_preset_names()):
        options = "; ".join(
            f"`{o.flag}`: {o.help[:1].lower()}{o.help[1:].rstrip('.')}" + (f" ({o.shown})" if o.shown else "")
            for o in list_options(reader.Options)
        )
        files = f"{reader.files}. {options}" if options else reader.files
        cells = [f"`{reader.name}`", files, reader.world, reader.checked_on]
        rows.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
    return "\n".join(rows) + "\n"


# Each module of this package that has ``READERS`` is one of readers.
for _name in sorted(module.name for module in pkgutil.iter_modules([os.path.dirname(__file__)])):
    if f"{__package__}.{_name}" != __name__:
        for _reader in getattr(importlib.import_module(f"{__package__}.{_name}"), "READERS", ()):
            register_reader(_reader)
