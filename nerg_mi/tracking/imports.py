"""Import of recordings as rays or into a dataset, and proposals how to import unknown files."""

from __future__ import annotations

import os
import secrets
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np

from nerg_mi.errors import NergError, clean_text, parameter, sanitize
from nerg_mi.files.atomic import check_writable
from nerg_mi.files.tables import write_json
from nerg_mi.files.values import FilePath, normalize_name, to_path
from nerg_mi.progress import Progress, Reporter, open_reporter
from nerg_mi.ranges import THREADS, check_ranges
from nerg_mi.threads import count_cpus

from .dataset import DATASET, UNKNOWN, RayDataset
from .dataset_write import DatasetUpdate, ImportRecipe, update_dataset
from .guess import Proposal, propose_imports
from .pseudonyms import make_file_aliases, pseudonymise, read_salt
from .quality import QualityReport, summarise, summarise_dataset
from .rays import SUFFIXES, Rays
from .readers.columns import ColumnMap
from .readers.registry import get_reader, make_options, read_rays

_MAX_ERRORS = 20  # files that could not be imported and are listed


@check_ranges
def import_rays(
    files: FilePath | Sequence[FilePath],
    reader: str = "table",
    settings: object | None = None,
    *,
    columns: str | ColumnMap | None = None,
    units: str | None = None,
    up: str | None = None,
    handedness: str | None = None,
    forward: str | None = None,
    radians: bool = False,
    person_from: str | None = None,
    tracking: str | None = None,
    min_confidence: float | None = None,
    valid: str | None = None,
    tick: float | None = None,
    skip_bad_lines: bool = False,
    pseudonyms: FilePath | None = None,
    environment: str | None = None,
    day: str | None = None,
    workers: Annotated[int, THREADS] | None = None,
    output: FilePath | None = None,
    align_output: FilePath | None = None,
    progress: Progress = None,
) -> Rays:
    """Convert tracking files to rays: right-handed, z up, metres, seconds.

    Parameters
    ----------
    files : path or sequence of path
        Tracking files (CSV, CSV.gz, Parquet, skeleton files); for some formats, folders.
    reader : str
        Name of the format, as for ``nerg rays import --preset``. ``table`` reads any CSV or Parquet table with
        ``columns``.
    settings : object, optional
        Options of the reader, such as ``SceneCameraOptions(poses="place")`` for ``neon``: an instance of its
        ``Options`` (`nerg_mi.tracking.readers`). Default: made of the keywords up to ``tick``.
    columns : str, optional
        Column map, as text: "origin=x,y,z direction=dx,dy,dz t=time person=id".
    units : str, optional
        Unit of length: m, cm or mm. This and the following options of readers default to those of the reader.
    up : str, optional
        Up axis: x, y, z, -x, -y or -z.
    handedness : str, optional
        Handedness: right or left.
    forward : str, optional
        Forward axis of the head's frame.
    radians : bool
        Angles are in radians instead of degrees.
    person_from : str, optional
        Source of the participants' names: column or filename.
    tracking : str, optional
        What the directions are: eye (gaze) or head.
    min_confidence : float, optional
        Drop rows below this confidence.
    valid : str, optional
        Columns of validity and their values for valid rows, as "gaze_status=2"; none: do not use any.
    tick : float, optional
        Unit of the file's time, in seconds.
    skip_bad_lines : bool
        Skip and report lines that cannot be read, up to 1 % of the lines of a file.
    pseudonyms : path, optional
        Replace the names of participants, also within file names, by hashes: "random" for a random salt that is not
        stored, or a file of at least 16 random bytes, so that several imports agree. Default: names are kept.
    environment : str, optional
        Name of the environment in which all files were recorded (datasets only). Default: unknown.
    day : str, optional
        Day of all recordings, as 2026-11-22 (datasets only). Default: from their times in UTC, else unknown.
    workers : int, optional
        Number of processes that import files in parallel (datasets only). Default: one per core.
    output : path, optional
        Rays file (.npz or .parquet) or dataset (.rays) to write.
    align_output : path, optional
        JSON file to write: the similarity from the rays to the frame of the input files, for ``align`` with a scene in
        that frame.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    Rays
        The gaze samples. Their ``metadata`` contain the number of dropped samples by reason. Of a dataset with more
        than a million rays in ``environment``, a sample is returned, as its metadata state.

    Raises
    ------
    NergError
        An argument or a file is invalid. Of a dataset, all other files are imported before.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> _ = (folder / "day.csv").write_text("t,who,x,y,z,dx,dy,dz\\n0.0,Ada,1,1,1.6,1,0,0\\n0.1,Ada,1,1,1.6,0,1,0\\n")
    >>> columns = "origin=x,y,z direction=dx,dy,dz t=t person=who"
    >>> rays = nerg.import_rays(folder / "day.csv", columns=columns)
    >>> len(rays), rays.persons
    (2, ('Ada',))
    """
    keywords = {
        "columns": _parse_columns(columns),
        "units": units,
        "up": up,
        "handedness": handedness,
        "forward": forward,
        "radians": radians or None,
        "person_from": person_from,
        "tracking": tracking,
        "min_confidence": min_confidence,
        "valid": valid,
        "tick": tick,
    }
    keywords = {name: value for name, value in keywords.items() if value is not None}
    if settings is not None and keywords:
        names = ", ".join(map(parameter, keywords))
        raise NergError(f"{names} and {parameter('settings')} are alternatives: set them in {parameter('settings')}")
    paths = _list_files(files)
    settings = make_options(reader, keywords) if settings is None else settings
    if not isinstance(settings, kind := get_reader(reader).Options):
        raise NergError(
            f"{parameter('settings')} of the reader {reader} must be {kind.__name__}, got {type(settings).__name__}"
        )
    salt = None if pseudonyms is None or str(pseudonyms) == "random" else read_salt(to_path(pseudonyms))
    key = None if pseudonyms is None else salt or secrets.token_bytes(32)
    is_dataset = output is not None and to_path(output).suffix.lower() == DATASET
    _check_outputs(output, align_output, is_dataset, {"environment": environment, "day": day, "workers": workers})
    with open_reporter(progress) as reporter:
        if is_dataset and output is not None:
            recipe = ImportRecipe(
                reader=get_reader(reader),
                settings=settings,
                skip_bad_lines=skip_bad_lines,
                place=normalize_name(environment or UNKNOWN),
                day=day,
                key=key,
                is_salt_stored=salt is not None,
            )
            report = _import_dataset(paths, to_path(output), recipe, workers or count_cpus(), reporter)
            names = [path.name for path in paths]
        else:
            rays = _import_files(paths, reader, settings, skip_bad_lines, reporter)
            names = [source["file"] for source in rays.metadata["sources"]]
            if key is not None:
                rays = pseudonymise(rays, key, is_salt_stored=salt is not None)
            similarity = None if align_output is None else _transform_to_files(rays)
            if output is not None:
                rays.save(output)
            if align_output is not None:
                write_json(to_path(align_output), similarity)
            report = QualityReport(rays, str(output or "rays"), summarise(rays))
        _print_report(report, {} if key is None else make_file_aliases(names, key), reporter)
        for path in (output, align_output):
            if path is not None:
                reporter.message(f"wrote {path}")
    return report.rays


def _parse_columns(columns: object) -> ColumnMap | None:
    if columns is None or isinstance(columns, ColumnMap):
        return columns
    if not isinstance(columns, str):
        raise NergError(
            f"{parameter('columns')} must be text as on the command line, such as "
            f"columns='origin=x,y,z direction=dx,dy,dz t=time', got {type(columns).__name__}"
        )
    return ColumnMap.parse(columns)


def _list_files(files: FilePath | Sequence[FilePath]) -> list[Path]:
    several = [files] if isinstance(files, (str, os.PathLike)) or not isinstance(files, Sequence) else files
    if not all(isinstance(file, (str, os.PathLike)) for file in several):
        raise NergError(
            f"import_rays reads files, given as strings or paths, got {type(files).__name__}; use Rays.from_dataframe "
            "for a data frame, and Rays.from_arrays for arrays"
        )
    if not several:
        raise NergError("there are no tracking files to read; list one or more")
    return [Path(file) for file in several]


def _check_outputs(
    output: FilePath | None, align_output: FilePath | None, is_dataset: bool, of_datasets: dict[str, object]
) -> None:
    """Raise `NergError` for outputs that cannot be written, before minutes of reading, and for arguments of datasets
    without one."""
    explicit = [name for name, value in of_datasets.items() if value is not None]
    if explicit and not is_dataset:
        raise NergError(f"{parameter(explicit[0])} applies to datasets only; use an output name that ends in {DATASET}")
    if align_output is not None and is_dataset:
        raise NergError(
            f"{parameter('align_output')} does not apply to datasets, whose sources may differ in their frames; "
            "write a rays file"
        )
    if output is not None and not is_dataset:
        check_writable(output, *SUFFIXES)
    if align_output is not None:
        check_writable(align_output, ".json")


def _import_files(paths: list[Path], reader: str, settings: object, skip_bad_lines: bool, reporter: Reporter) -> Rays:
    begun: list[str] = []

    def report(name: str) -> None:
        reporter.progress(min(len(begun) / len(paths), 1.0), f"reading {name}")
        begun.append(name)

    return read_rays(reader, paths, settings, skip_bad_lines=skip_bad_lines, on_source=report)


def _import_dataset(
    paths: list[Path], folder: Path, recipe: ImportRecipe, workers: int, reporter: Reporter
) -> QualityReport:
    """Import files into a dataset, except those that are there unchanged, and return the report of their environment.

    Raises `NergError` if some files could not be imported, after all others were.
    """
    done: list[str] = []

    def report(name: str) -> None:
        done.append(name)
        reporter.progress(min(len(done) / len(paths), 1.0), f"imported {name}")

    update = update_dataset(folder, paths, recipe, workers, report)
    _report_update(update, reporter)
    if update.errors:
        count_note = (
            f" ({len(update.errors)} of {len(paths)} files could not be imported; the others were)"
            if len(paths) > 1
            else ""
        )
        for error in update.errors[1:_MAX_ERRORS]:
            reporter.message(sanitize(error, 2000))
        raise NergError(update.errors[0] + count_note)
    return summarise_dataset(RayDataset.open(folder).select_place(recipe.place), str(folder))


def _report_update(update: DatasetUpdate, reporter: Reporter) -> None:
    """Report what was imported, in one line."""
    parts = [
        f"imported {update.num_imported:,} sources, {update.num_rays:,} rays"
        if update.num_imported
        else "nothing to import"
    ]
    parts += [
        f"{count:,} {what}"
        for count, what in (
            (update.num_unchanged, "unchanged"),
            (update.num_duplicates, "given twice"),
            (update.num_replaced, "replaced"),
        )
        if count
    ]
    reporter.message("; ".join(parts))
    for path in update.empty[:_MAX_ERRORS]:
        reporter.message(sanitize(f"{path}: none of its rows gives a ray; the report lists why", 2000))


def _transform_to_files(rays: Rays) -> list[list[float]]:
    """Return the similarity (4 rows) from the rays to the frame of the input files."""
    back = np.linalg.inv(np.array(rays.metadata["transform"], np.float64))
    if np.linalg.det(back[:3, :3]) < 0:
        raise NergError(
            "the frame of the files is left-handed and that of rays right-handed, so no similarity connects them; "
            f"leave out {parameter('align_output')}, and align the rays with the scene"
        )
    return (back + 0.0).tolist()


def _print_report(report: QualityReport, aliases: dict[str, str], reporter: Reporter) -> None:
    """Print the report, and names of files by those of their ``aliases`` that it shows; no file contains them."""
    text = report.to_text()
    reporter.message(text)
    unwrapped = "".join(text.split())
    for alias, file in aliases.items():
        if alias in unwrapped:
            reporter.message(f"{alias} is {sanitize(file, 200)} (only shown here)")


def guess(files: FilePath | Sequence[FilePath], *, progress: Progress = None) -> list[Proposal]:
    """Propose the preset or the column map for unknown tracking files: what is certain, a guess, and not stated.

    Nothing is imported. The complete import command is printed, once for all files of the same format, to be checked
    and run.

    Parameters
    ----------
    files : path or sequence of path
        Tracking files of unknown format, or folders of them.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    list of Proposal
        One for all files of the same format: the name of the reader (``preset``) or the ``columns`` of a table, what is
        ``certain``, the ``assumptions`` and the open ``questions``, and the complete ``command``.

    Raises
    ------
    NergError
        A file is not a table, or is damaged.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> rows = "".join(f"{t / 10},Ada,1,1,1.6,1,0,0\\n" for t in range(20))
    >>> _ = (folder / "day.csv").write_text("time,participant,x,y,z,dx,dy,dz\\n" + rows)
    >>> str(nerg.guess(folder / "day.csv")[0].columns)
    'origin=x,y,z direction=dx,dy,dz t=time person=participant'
    """
    paths = _list_files(files)
    with open_reporter(progress) as reporter:
        reporter.progress(0.0, f"reading {paths[0].name}")
        proposals = propose_imports(paths)
        for k, proposal in enumerate(proposals):
            if len(proposals) > 1 or proposal.paths[0] not in paths:
                count_note = f" and {len(proposal.paths) - 1} more" if len(proposal.paths) > 1 else ""
                reporter.message("\n" * (k > 0) + sanitize(f"{proposal.paths[0]}{count_note}", 2000))
            evidence = {"sure": proposal.certain, "guess": proposal.assumptions, "open": proposal.questions}
            for name, sentences in evidence.items():
                for sentence in sentences:
                    reporter.message(f"{name:6} {sanitize(sentence, 2000)}")
            reporter.message("")
            reporter.message(sanitize(proposal.command or "no command can be proposed", 100_000))
            # Messages spell parameters as their reporter does, and the result as in Python.
            for sentences in (proposal.assumptions, proposal.questions):
                sentences[:] = map(clean_text, sentences)
    return proposals
