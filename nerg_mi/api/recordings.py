"""Recordings: import, guesses of formats, data-quality reports, selections, splits, plans, and alignment."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from nerg_mi.errors import NergError, clean_text
from nerg_mi.files.values import FilePath
from nerg_mi.rays.rays import Rays
from nerg_mi.workflows.rays_commands import FilterOptions, PlotOptions, RaysImportOptions, SplitOptions

from .arguments import check_names, check_output, resolve_file
from .calls import Progress, report_progress, show_figure
from .objects import build_options, resolve_rays

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from nerg_mi.rays.guess import Proposal
    from nerg_mi.rays.in_memory import QualityReport


def import_rays(
    files: FilePath | Sequence[FilePath],
    reader: str = "table",
    *,
    output: FilePath | None = None,
    progress: Progress = None,
    **options: Any,
) -> Rays:
    """Import gaze recordings.

    Parameters
    ----------
    files : path or sequence of path
        Recordings.
    reader : str
        Name of the format, as for ``nerg rays import --preset``. ``table`` reads any CSV or Parquet table with the
        option ``columns``.
    output : path, optional
        File to write (.npz or .parquet), or a dataset (.rays).
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.
    **options
        Options of the reader; ``skip_bad_lines``, ``pseudonyms`` and ``salt``; and for a dataset ``environment``,
        ``day`` and ``workers`` (`nerg_mi.workflows.rays_commands.RaysImportOptions`).

    Returns
    -------
    Rays
        The gaze samples, right-handed with z up, in metres and seconds. Their ``metadata`` contains the number of
        dropped samples by reason. A large dataset is subsampled (`nerg_mi.workflows.rays.ImportResult`).

    Raises
    ------
    NergError
        An option or a file is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> _ = (folder / "day.csv").write_text("t,who,x,y,z,dx,dy,dz\\n0.0,Ada,1,1,1.6,1,0,0\\n0.1,Ada,1,1,1.6,0,1,0\\n")
    >>> columns = "origin=x,y,z direction=dx,dy,dz t=t person=who"
    >>> rays = nerg.import_rays(folder / "day.csv", columns=columns)
    >>> len(rays), rays.persons
    (2, ('Ada',))
    """
    from nerg_mi.rays.readers.base import list_options
    from nerg_mi.rays.readers.registry import get_reader, list_reader_names, make_options
    from nerg_mi.workflows import rays

    with report_progress(progress) as reporter:
        file_list = [files] if isinstance(files, (str, os.PathLike)) or not isinstance(files, Sequence) else files
        if not all(isinstance(file, (str, os.PathLike)) for file in file_list):
            raise NergError(
                f"import_rays reads files, given as strings or paths, got {type(files).__name__}; "
                "use Rays.from_dataframe for a data frame, and Rays.from_arrays for arrays"
            )
        reader_options = list_options(get_reader(reader).Options)
        import_options = {f.name for f in fields(RaysImportOptions)} - {"reader", "settings", "output"}
        all_reader_options = {
            option.name for name in list_reader_names() for option in list_options(get_reader(name).Options)
        }
        check_names("import_rays", options, sorted(all_reader_options | import_options))
        paths = [resolve_file(file, "files") for file in file_list]
        import_values = {name: value for name, value in options.items() if name in import_options}
        parsers = {option.name: option.parse for option in reader_options}
        reader_values = {name: value for name, value in options.items() if name not in import_options}
        for name, value in reader_values.items():
            # Values can be strings, as on the command line.
            if (parser := parsers.get(name)) is None:
                continue
            if isinstance(value, str):
                reader_values[name] = parser(value)
            elif isinstance(value, (Mapping, list, tuple)):
                raise NergError(
                    f"{name} is text as on the command line, such as columns='origin=x,y,z direction=dx,dy,dz t=time', "
                    f"got {type(value).__name__}"
                )
        resolved = RaysImportOptions(
            reader=reader, settings=make_options(reader, reader_values), output=output, **import_values
        )
        return rays.import_rays(paths, resolved, reporter).rays


def guess(files: FilePath | Sequence[FilePath], *, progress: Progress = None) -> list[Proposal]:
    """Propose how to import tracking files of unknown format.

    Nothing is imported.

    Parameters
    ----------
    files : path or sequence of path
        Tables, or folders of recordings or tables.
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.

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
    from nerg_mi.workflows.rays import guess_imports

    several = [files] if isinstance(files, (str, os.PathLike)) else list(files)
    with report_progress(progress) as reporter:
        proposals = guess_imports([resolve_file(file, "files") for file in several], reporter)
    for proposal in proposals:
        for sentences in (proposal.assumptions, proposal.questions):
            sentences[:] = map(clean_text, sentences)
    return proposals


def check_rays(rays: Rays | FilePath, *, progress: Progress = None) -> QualityReport:
    """Make the data-quality report of recordings: figures, dropped rows, and warnings about implausible data.

    Parameters
    ----------
    rays : Rays or path
        Recordings, their file, or a dataset of one environment.
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.

    Returns
    -------
    QualityReport
        The report, which prints as a table; its ``warnings`` are sentences, its ``summary`` has the figures.

    Raises
    ------
    NergError
        There are no rays, or the dataset has several environments.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> report = nerg.check_rays(rays)
    >>> report.summary.persons, dict(report.lines)["participants"]
    (2, '2: Ada, Bob')
    """
    from nerg_mi.rays import in_memory
    from nerg_mi.workflows.rays import make_quality_report

    data = resolve_rays(rays)
    with report_progress(progress) as reporter:
        if isinstance(data, Rays):
            return in_memory.check_rays(data, "rays")
        reports = make_quality_report(data, reporter)
    if len(reports) > 1:
        places = ", ".join(title for title, _ in reports)
        raise NergError(f'"{data}" contains {len(reports)} environments ({places}); check one of them')
    ((title, card),) = reports
    return in_memory.QualityReport(card.rays, title, card.summary, card.lines)


def filter_rays(
    rays: Rays | FilePath, *, options: FilterOptions | None = None, progress: Progress = None, **overrides: Any
) -> Rays:
    """Select rays by conditions, detect fixations, and thin out stationary periods.

    Parameters
    ----------
    rays : Rays or path
        The rays, or their file.
    options : FilterOptions, optional
        Base options (`nerg_mi.workflows.rays_commands.FilterOptions`).
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.
    **overrides
        Single options on top of ``options``, such as ``persons=["Ada"]``, ``start=10``, ``fixations="ivt"`` or
        ``output="day.npz"``.

    Returns
    -------
    Rays
        The selected rays; the steps are recorded in their metadata.

    Raises
    ------
    NergError
        An option is invalid, or no ray is selected.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> nerg.filter_rays(rays, persons=["Ada"], sample=100)
    <Rays: 100 of 1 participant, t 0.2 to 199.8 s>
    """
    from nerg_mi.rays.dataset import load_rays
    from nerg_mi.workflows.rays import filter_rays as select

    with report_progress(progress) as reporter:
        resolved = build_options(FilterOptions, "filter_rays", options, overrides)
        result = select(resolve_rays(rays), resolved, reporter)
        if result.rays is not None:
            return result.rays
        # A dataset was written to another one.
        assert resolved.output is not None
        return load_rays(resolved.output)


def split_rays(
    rays: Rays | FilePath, *, options: SplitOptions | None = None, progress: Progress = None, **overrides: Any
) -> tuple[Rays, Rays]:
    """Split rays into training and test rays that share no position, participant or period.

    Parameters
    ----------
    rays : Rays or path
        The rays, or their file.
    options : SplitOptions, optional
        Base options (`nerg_mi.workflows.rays_commands.SplitOptions`).
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.
    **overrides
        Single options on top of ``options``: ``test_participants=0.5``, ``test_zones=3``, ``test_time=0.2`` or several.

    Returns
    -------
    train, test : Rays
        Rays on the training side and on the test side of each criterion; others are in neither.

    Raises
    ------
    NergError
        There is no criterion, or an option is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> train, test = nerg.split_rays(rays, test_participants=0.5)
    >>> sorted(train.participants + test.participants)
    ['Ada', 'Bob']
    """
    from nerg_mi.workflows.rays import split_rays as split

    with report_progress(progress) as reporter:
        resolved = build_options(SplitOptions, "split_rays", options, overrides)
        result = split(resolve_rays(rays), resolved, reporter)
    return result.train, result.test


def plot_rays(
    rays: Rays | FilePath,
    output: FilePath | None = None,
    *,
    axes: Axes | None = None,
    options: PlotOptions | None = None,
    progress: Progress = None,
    **overrides: Any,
) -> Figure:
    """Draw a floor plan of recorded positions.

    Parameters
    ----------
    rays : Rays or path
        The rays, or their file.
    output : path, optional
        Image to write (.png or .svg).
    axes : matplotlib.axes.Axes, optional
        Axes to draw in. Default: a new figure.
    options : PlotOptions, optional
        Base options (`nerg_mi.workflows.rays_commands.PlotOptions`).
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.
    **overrides
        Single options on top of ``options``: ``kind="layout"`` with ``test`` (rays of a split), or ``cell_size=0.2``.

    Returns
    -------
    matplotlib.figure.Figure
        The figure.

    Raises
    ------
    NergError
        An option is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> len(nerg.plot_rays(rays).axes) > 0
    True
    """
    from nerg_mi.figures.style import figure_of
    from nerg_mi.workflows.rays import plot_rays as plot

    check_output(output)
    with report_progress(progress) as reporter:
        changes = overrides if output is None else {**overrides, "output": output}
        resolved = build_options(PlotOptions, "plot_rays", options, changes)
        figure = figure_of(plot(resolve_rays(rays), resolved, reporter, axes))
    return show_figure(figure) if axes is None else figure
