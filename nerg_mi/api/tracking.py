"""Tracking files in, rays out."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from nerg_mi.errors import NergError
from nerg_mi.workflows.base import SILENT, Reporter

from .options import check_names, file_of

if TYPE_CHECKING:
    from nerg_mi.rays.rays import Rays

    from .fields import FilePath


def import_rays(
    files: FilePath | Sequence[FilePath],
    reader: str = "table",
    *,
    output: FilePath | None = None,
    reporter: Reporter = SILENT,
    **options: Any,
) -> Rays:
    """Read tracking files as rays of attention: right-handed, z up, metres, seconds.

    ``files``: one or several. ``reader``: the format's name, as for ``nerg rays import --preset``; ``table`` reads any
    CSV or Parquet table through the option ``columns``. ``output``: rays file to write besides (.npz or .parquet), or a
    dataset (.rays), of which large ones are given as a sample (`nerg_mi.workflows.rays.ImportResult`).
    ``options``: those of the reader, and ``skip_bad_lines``, ``pseudonyms`` and ``salt``, of a dataset ``place_name``,
    ``day`` and ``workers`` (`nerg_mi.workflows.rays.ImportOptions`). What was dropped, and why, is in the rays'
    ``metadata``. Raises `NergError`.

    >>> import nerg_mi as nerg
    >>> _ = (folder / "day.csv").write_text("t,who,x,y,z,dx,dy,dz\\n0.0,Ada,1,1,1.6,1,0,0\\n0.1,Ada,1,1,1.6,0,1,0\\n")
    >>> columns = "origin=x,y,z direction=dx,dy,dz t=t person=who"
    >>> rays = nerg.import_rays(folder / "day.csv", columns=columns)
    >>> len(rays), rays.persons
    (2, ('Ada',))
    """
    from nerg_mi.rays.readers.base import options_of
    from nerg_mi.rays.readers.registry import make_options, reader_named, reader_names
    from nerg_mi.workflows import rays

    several = [files] if isinstance(files, (str, os.PathLike)) or not isinstance(files, Sequence) else files
    if not all(isinstance(file, (str, os.PathLike)) for file in several):
        raise NergError(
            f"import_rays reads files, named by strings or paths, got {type(files).__name__}; "
            'write a table to a file (df.to_csv("day.csv")), and name its columns (columns="origin=x,y,z ...")'
        )
    of_readers = options_of(reader_named(reader).Options)
    ours = {f.name for f in fields(rays.ImportOptions)} - {"reader", "settings", "output"}
    every = {option.name for name in reader_names() for option in options_of(reader_named(name).Options)}
    check_names("import_rays", options, sorted(every | ours))
    paths = [file_of(file, "files") for file in several]
    of_job = {name: value for name, value in options.items() if name in ours}
    parse = {option.name: option.parse for option in of_readers}
    of_reader = {name: value for name, value in options.items() if name not in ours}
    for name, value in of_reader.items():
        # Values may be written as for the command.
        if isinstance(value, str) and (read := parse.get(name)) is not None:
            of_reader[name] = read(value)
    job = rays.ImportOptions(reader=reader, settings=make_options(reader, of_reader), output=output, **of_job)
    return rays.import_rays(paths, job, reporter).rays
