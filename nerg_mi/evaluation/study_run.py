"""Study of rendering error against run time over many settings, directly or in parts."""

from __future__ import annotations

import re
import time
import uuid
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from nerg_mi.environment.planned import PlannedFiles
from nerg_mi.environment.scene_loading import (
    activate_mitsuba,
    activate_variant,
    list_library_versions,
    list_scene_files,
)
from nerg_mi.errors import NergError
from nerg_mi.figures.style import Provenance, changed_arguments, existing_files, make_provenance
from nerg_mi.files.atomic import make_folder
from nerg_mi.files.dataframes import ResultTables
from nerg_mi.files.safe_read import read_json
from nerg_mi.files.tables import write_json
from nerg_mi.files.values import FilePath
from nerg_mi.progress import Progress, open_reporter
from nerg_mi.ranges import Range, check_ranges
from nerg_mi.tasks.execution import prepare_once
from nerg_mi.tasks.parts import PartRunner
from nerg_mi.tasks.settings import Parallel
from nerg_mi.tasks.task import Part, Plan, read_processor_name

from . import study as measuring
from . import study_tables, study_truth
from .study import StudyRow, list_rows
from .study_subject import ExactSurfaces, FileSubject, StudySubject, open_subject

# ---- Study: a scene rendered with many settings, compared with a reference ----

ROWS = 4
"""Number of settings in a part, in addition to the default."""

_TWIN = "twin.xml"
_PROCESS = uuid.uuid4().hex


@dataclass(frozen=True, repr=False)
class StudyResult(ResultTables):
    """Result of `study`: ``report``, the content of study.json, with ``rows`` and ``against_paper``."""

    TABLES = ("rows",)

    report: dict
    provenance: Provenance

    @property
    def rows(self) -> list[dict]:
        """One row per setting: errors and run times."""
        return self.report["rows"]

    def save(self, folder: FilePath) -> list[Path]:
        """Write tables and plots to ``folder``, and return their paths.

        These are study.csv (one row per setting), study.md (grouped by parameter), scaling.csv, study.json, errors.png
        and scaling.png. Raises `NergError` if they cannot be written.
        """
        folder, report = make_folder(Path(folder)), self.report
        files = study_tables.write_tables(folder, report)
        width, height = report["size"]
        title = f"{report['scene']}, {width} x {height}, {report['variant']}"
        errors, scaling = folder / "errors.png", folder / "scaling.png"
        study_tables.plot_errors(errors, self.rows, f"Error against time: {title}", self.provenance)
        study_tables.plot_scaling(scaling, report["scaling"], f"Cost of the default: {title}", self.provenance)
        return [*files, errors, scaling]


@check_ranges
def study(
    scene: FilePath | Any,
    *,
    width: Annotated[int, Range(4, 16384)] = 192,
    height: Annotated[int, Range(4, 16384)] = 128,
    repeats: Annotated[int, Range(1, 10000)] = 5,
    quick: bool = False,
    only: str = "",
    defaults: Mapping[str, str] | None = None,
    parallel: Parallel = Parallel(),
    progress: Progress = None,
) -> StudyResult:
    """Measure rendering error against run time: render a scene with many settings, and compare with a reference.

    Writes study.csv (one row per setting), study.md (grouped by parameter), scaling.csv, study.json and two plots. A
    full study takes up to half an hour.

    Parameters
    ----------
    scene : path, Scene or mi.Scene
        Scene file (.xml), or a built-in scene with an exact solution: slab, sphere, sheets, fog or ramp.
    width : int
        Width of the images in pixels.
    height : int
        Height of the images in pixels.
    repeats : int
        Number of timed renders of each setting; the median is reported.
    quick : bool
        Run a small subset of the settings, each timed once.
    only : str
        Regular expression: run only the default and settings whose names match. Default: all settings.
    defaults : mapping, optional
        Value of a <default> of the scene file, or of $KEY; repeatable. Default: as in the scene file.
    parallel : Parallel
        Where parts run (`nerg_mi.tasks.settings.Parallel`). A few settings form a part. Errors are the same, and times
        are those of the measuring process, with its time of the default setting in the same row.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    StudyResult
        Errors and run times, with a method ``save`` for a folder of tables and plots.

    Raises
    ------
    NergError
        The scene cannot be studied, or an argument is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> result = nerg.study("slab", quick=True, width=8, height=8)
    >>> result.save(folder / "study")[0].name
    'study.csv'
    """
    changed = changed_arguments(study, locals())
    pattern = _compile_pattern(only)
    mode = str(activate_mitsuba().variant())
    import drjit as dr

    begin = time.perf_counter()
    with open_reporter(progress) as reporter:
        reporter.progress(0.0, "open")
        scene = getattr(scene, "path", None) or getattr(scene, "mitsuba", scene)
        subject = open_subject(scene, "auto", width, height, defaults, find_reference_scene)
        rows = _select_settings(list_rows(subject, quick), pattern, only)
        if quick:
            repeats = 1
        timed_by: list[dict] = []
        done = 0

        def step(name: str) -> None:
            nonlocal done
            # First and timed renders of each row, and the scaling, which is about a tenth of it.
            reporter.progress(min(done / (2.2 * len(rows)), 0.99), name)
            done += 1

        if parallel.in_parts:
            common = plan_study(subject, scene, defaults, mode, quick, repeats)
            table, scaling, timed_by = _measure_in_parts(common, subject, rows, PartRunner(parallel, None, reporter))
        else:
            table = measuring.measure_rows(subject, rows, repeats, _reference_samples(quick), step)
            scaling = measuring.measure_scaling(subject, min(repeats, 3), quick, step)
        study_tables.mark_pareto_fronts(table)
        reference = subject.get_truth(measuring.SEED, "expected", "depth")
        report = {
            "scene": subject.name,
            "variant": mode,
            "size": [width, height],
            "extent": subject.extent,
            "step": subject.step,
            "tolerance": subject.tolerance,
            "reference": reference.source,
            "reference_change_when_step_halved": reference.convergence,
            "precision": measuring.describe_precision(),
            "gaze_kld_eps": study_truth.KLD_EPS,
            "repeats": repeats,
            "threads": timed_by[0]["threads"] if timed_by else dr.thread_count(),
            "timed_by": timed_by,
            "peak_mb": "what Dr.Jit allocated at most during a first render, in MiB, beyond scene and field",
            "seconds_of_study": time.perf_counter() - begin,
            "versions": list_library_versions(mode),
            "against_paper": study_tables.compare_with_paper(table),
            "rows": table,
            "scaling": scaling,
        }
        study_tables.add_row_notes(report)
        sources = list_scene_files(scene, defaults) if existing_files(scene) else []
        for line in study_tables.summarise(report):
            reporter.message(line)
    return StudyResult(report, make_provenance("nerg study", sources, measuring.SEED, changed))


def _compile_pattern(only: str) -> re.Pattern:
    try:
        return re.compile(only)
    except re.error as error:
        raise NergError(f'"{only}" is not a regular expression ({error}): name settings as in "depth|paper"') from error


def _select_settings(all_settings: list[StudyRow], pattern: re.Pattern, only: str) -> list[StudyRow]:
    """Return the default setting, which is the first, and the settings whose names match."""
    default, *other_settings = all_settings
    rows = [default, *(row for row in other_settings if pattern.search(row.name))]
    if only and len(rows) == 1:
        raise NergError(
            f'no setting matches "{only}"; names are those in study.csv, such as "{other_settings[0].name}"'
        )
    return rows


def _reference_samples(quick: bool) -> int:
    """Return the samples per pixel of the reference."""
    return 16 if quick else measuring.PIXEL_SPP


def find_reference_scene(scene: Path) -> ExactSurfaces | None:
    """Return the surfaces in ``twin.xml`` next to a scene file, the reference of its field; None if there is none."""
    file = scene.parent / _TWIN
    if not file.is_file():
        return None
    from nerg_mi.scenes.store import twin  # pyright: ignore[reportMissingImports] at the root of a checkout

    shapes = twin.load_twin(file)
    return ExactSurfaces(partial(twin.cast_rays, scene=shapes), partial(twin.is_visible, scene=shapes))


# ---- Parts ----
#
# A part measures a few settings and the default. Errors and evaluations do not depend on the machine. Times are those
# of the measuring process; its times of the default setting, taken in the same rounds, are in the same row, so that
# rows of different machines can be compared.


@dataclass(frozen=True)
class PlannedStudy:
    """Inputs that all parts share; ``scene`` is a file or the name of an analytic scene."""

    scene: PlannedFiles | str
    size: tuple[int, int]
    mode: str
    quick: bool
    repeats: int


def plan_study(
    subject: StudySubject, scene: Any, defaults: Mapping[str, str] | None, mode: str, quick: bool, repeats: int
) -> PlannedStudy:
    """Return the inputs of parts for the ``subject`` of ``scene``; parts refer to settings by number.

    Raises `NergError` for a scene in memory.
    """
    common = (subject.size, mode, quick, repeats)
    if not isinstance(subject, FileSubject):
        return PlannedStudy(str(scene), *common)
    if not isinstance(scene, (str, Path)):
        raise NergError("parts read the scene from a file; save the scene, and pass its path")
    twin = Path(scene).parent / _TWIN
    extra_files = list_scene_files(twin) if twin.is_file() else ()
    return PlannedStudy(PlannedFiles.plan(scene, defaults, *extra_files), *common)


def _measure_in_parts(
    common: PlannedStudy, subject: StudySubject, rows: Sequence[StudyRow], parts: PartRunner
) -> tuple[list[dict], list[dict], list[dict]]:
    """Measure ``rows`` (the default first) and the scaling in parts.

    Returns the rows, the scaling, and for each process its ``processor``, ``threads``, number of ``rows`` and, for the
    default setting, minimum and maximum ``seconds``. Rows name their process in ``timed_by``, counted from 1, and have
    its ``default_seconds`` and ``default_cpu_seconds``.
    """
    place = {row.name: k for k, row in enumerate(list_rows(subject, common.quick))}
    numbers = [place[row.name] for row in rows[1:]]
    some = [tuple(numbers[k : k + ROWS]) for k in range(0, len(numbers), ROWS)]
    tasks = [Part(numbers, f"{len(numbers)} settings from number {numbers[0]}") for numbers in some]
    tasks.append(Part(None, "cost against size"))
    plan = Plan(f"nerg study {subject.name}", measure_part, common, tasks, ".json")
    return _join_parts([read_json(made.path, "part of a study") for made in parts.run(plan)])


def measure_part(common: PlannedStudy, numbers: Sequence[int] | None, output: Path) -> None:
    """Write the rows (JSON) of the settings ``numbers``, the default first, or of the scaling if it is None.

    The measuring process is stored, too.
    """
    import drjit as dr

    activate_variant(common.mode)

    def open_planned() -> StudySubject:
        scene, kind, defaults = common.scene, "analytic", {}
        if isinstance(scene, PlannedFiles):
            scene, kind, defaults = str(scene.checked_path()), "file", scene.defaults
        return open_subject(scene, kind, *common.size, defaults, find_reference_scene)

    # Its reference may take longer than its settings.
    subject = prepare_once(common, open_planned)
    if numbers is None:
        rows = measuring.measure_scaling(subject, min(common.repeats, 3), common.quick)
    else:
        every = list_rows(subject, common.quick)
        chosen = [every[k] for k in (0, *numbers)]
        rows = measuring.measure_rows(subject, chosen, common.repeats, _reference_samples(common.quick))
    timed_by = {"process": _PROCESS, "processor": read_processor_name(), "threads": dr.thread_count()}
    write_json(output, {"rows": rows, "timed_by": timed_by}, allow_nan=True)


def _join_parts(parts: Iterable[Any]) -> tuple[list[dict], list[dict], list[dict]]:
    """Return the rows of all parts with a single default, the scaling, and the measuring processes."""
    *of_settings, scaling = parts
    table: list[dict] = []
    who: dict[str, dict] = {}
    for part in of_settings:
        by, (default, *rest) = part["timed_by"], part["rows"]
        of_process = who.setdefault(by["process"], {**by, "process": len(who) + 1, "rows": 0, "seconds": []})
        of_process["seconds"].append(default["seconds"])
        for row in rest if table else (default, *rest):
            default_times = {f"default_{clock}": default[clock] for clock in ("seconds", "cpu_seconds")}
            table.append(row | default_times | {"timed_by": of_process["process"]})
            of_process["rows"] += 1
    for results in who.values():
        results["seconds"] = [min(results["seconds"]), max(results["seconds"])]
    return table, scaling["rows"], list(who.values())
