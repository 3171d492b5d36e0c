"""Study of rendering error against run time over many settings, directly or in parts."""

from __future__ import annotations

import re
import time
import uuid
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError
from nerg_mi.evaluation import study, study_tables, study_truth
from nerg_mi.evaluation.study import StudyRow, list_rows
from nerg_mi.evaluation.study_subject import ExactSurfaces, FileSubject, StudySubject, open_subject
from nerg_mi.figures.style import Provenance, existing_files, make_provenance
from nerg_mi.files.atomic import check_folder
from nerg_mi.files.dataframes import ResultTables
from nerg_mi.files.safe_read import read_json
from nerg_mi.files.tables import write_json
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.rendering.scene import activate_variant, list_scene_files
from nerg_mi.tasks.execution import prepare_once
from nerg_mi.tasks.task import Part, Plan, read_processor_name

from .base import select_backend, versions
from .parts import PartRunner, PlannedScene
from .scene_commands import StudyOptions

# ---- Study: a scene rendered with many settings, compared with a reference ----


ROWS = 4
"""Number of settings in a part, in addition to the default."""

_TWIN = "twin.xml"
_PROCESS = uuid.uuid4().hex


@dataclass(frozen=True, repr=False)
class StudyResult(ResultTables):
    """Written ``files``; ``report``, the content of study.json, with ``rows`` and ``against_paper``."""

    TABLES = ("rows",)

    files: list[Path]
    report: dict

    @property
    def rows(self) -> list[dict]:
        """One row per setting: errors and run times."""
        return self.report["rows"]


def run_study(
    scene: str | Path, output: str | Path, options: StudyOptions | None = None, reporter: Reporter = SILENT
) -> StudyResult:
    """Study ``scene``, a scene file or the name of an analytic scene, and write tables and plots to ``output``.

    The files are study.csv (one row per setting), study.md (grouped by parameter), scaling.csv, study.json and two
    plots. With ``options.store`` or ``options.scheduler`` a few settings form a part, which is stored and may run
    elsewhere: errors are the same, and times are those of the measuring process, with its time of the default setting
    in the same row. Raises `NergError` for errors that the user can correct, before anything is written.
    """
    options = options or StudyOptions()
    width, height = options.width, options.height
    if min(width, height) < 4 or options.repeats < 1:
        raise NergError(
            f"a study needs images of at least 4 x 4 pixels and one timed render, got {width} x {height} and "
            f"{options.repeats}"
        )
    pattern = _expression(options.only)
    output = Path(output)
    check_folder(output)
    mode = activate_variant(options.mode)
    import drjit as dr

    begin = time.perf_counter()
    reporter.progress(0.0, "open")
    subject = open_subject(str(scene), options.scene_kind, width, height, options.defaults, find_reference_scene)
    rows = _select_settings(list_rows(subject, options.quick), pattern, options.only)
    repeats, samples = effort(options)
    timed_by: list[dict] = []
    done = 0

    def step(name: str) -> None:
        nonlocal done
        # First and timed renders of each row, and the scaling, which is about a tenth of it.
        reporter.progress(min(done / (2.2 * len(rows)), 0.99), name)
        done += 1

    if options.in_parts:
        common = plan_study(subject, scene, replace(options, mode=mode))
        table, scaling, timed_by = _measure_in_parts(
            common, subject, rows, PartRunner(options, output, reporter), output
        )
    else:
        table = study.measure_rows(subject, rows, repeats, samples, step)
        scaling = study.measure_scaling(subject, min(repeats, 3), options.quick, step)
    study_tables.mark_pareto_fronts(table)
    reference = subject.get_truth(study.SEED, "expected", "depth")
    report = {
        "scene": subject.name,
        "variant": mode,
        "size": [width, height],
        "extent": subject.extent,
        "step": subject.step,
        "tolerance": subject.tolerance,
        "reference": reference.source,
        "reference_change_when_step_halved": reference.convergence,
        "precision": study.describe_precision(),
        "gaze_kld_eps": study_truth.KLD_EPS,
        "repeats": repeats,
        "threads": timed_by[0]["threads"] if timed_by else dr.thread_count(),
        "timed_by": timed_by,
        "peak_mb": "what Dr.Jit allocated at most during a first render, in MiB, beyond scene and field",
        "seconds_of_study": time.perf_counter() - begin,
        "versions": versions(mode),
        "against_paper": study_tables.compare_with_paper(table),
        "rows": table,
        "scaling": scaling,
    }
    sources = list_scene_files(scene, options.defaults) if existing_files(scene) else []
    files = _write(output, subject, report, make_provenance("nerg study", sources, study.SEED, options))
    for line in study_tables.summarise(report):
        reporter.message(line)
    for path in files:
        reporter.message(f"wrote {path}")
    return StudyResult(files, report)


def _expression(only: str) -> re.Pattern:
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


def _write(output: Path, subject: StudySubject, report: dict, record: Provenance) -> list[Path]:
    files = study_tables.write_tables(output, report)
    width, height = report["size"]
    title = f"{subject.name}, {width} x {height}, {report['variant']}"
    study_tables.plot_errors(output / "errors.png", report["rows"], f"Error against time: {title}", record)
    study_tables.plot_scaling(output / "scaling.png", report["scaling"], f"Cost of the default: {title}", record)
    return [*files, output / "errors.png", output / "scaling.png"]


def effort(options: StudyOptions) -> tuple[int, int]:
    """Return the number of timed renders of each setting, and the samples per pixel of the reference."""
    return (1, 16) if options.quick else (options.repeats, study.PIXEL_SPP)


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
    """Inputs that all parts share: ``options`` and ``scene``, a file or the name of an analytic scene."""

    options: StudyOptions
    scene: PlannedScene | str


def plan_study(subject: StudySubject, scene: str | Path, options: StudyOptions) -> PlannedStudy:
    """Return the inputs of parts for the ``subject`` of ``scene``; parts refer to settings by number."""
    kind = "file" if isinstance(subject, FileSubject) else "analytic"
    of_parts = replace(options, only="", defaults=None, scene_kind=kind)
    if kind == "analytic":
        return PlannedStudy(of_parts, str(scene))
    twin = Path(scene).parent / _TWIN
    extra_files = list_scene_files(twin) if twin.is_file() else ()
    return PlannedStudy(of_parts, PlannedScene.plan(scene, options.defaults, *extra_files))


def _measure_in_parts(
    common: PlannedStudy, subject: StudySubject, rows: Sequence[StudyRow], parts: PartRunner, output: Path
) -> tuple[list[dict], list[dict], list[dict]]:
    """Measure ``rows`` (the default first) and the scaling in parts.

    Returns the rows, the scaling, and for each process its ``processor``, ``threads``, number of ``rows`` and, for the
    default setting, minimum and maximum ``seconds``. Rows name their process in ``timed_by``, counted from 1, and have
    its ``default_seconds`` and ``default_cpu_seconds``.
    """
    place = {row.name: k for k, row in enumerate(list_rows(subject, common.options.quick))}
    numbers = [place[row.name] for row in rows[1:]]
    some = [tuple(numbers[k : k + ROWS]) for k in range(0, len(numbers), ROWS)]
    tasks = [Part(numbers, f"{len(numbers)} settings from number {numbers[0]}") for numbers in some]
    tasks.append(Part(None, "cost against size"))
    plan = Plan(f"nerg study {output.absolute()}", measure_part, common, tasks, ".json")
    return _join_parts([read_json(made.path, "part of a study") for made in parts.run(plan)])


def measure_part(common: PlannedStudy, numbers: Sequence[int] | None, output: Path) -> None:
    """Write the rows (JSON) of the settings ``numbers``, the default first, or of the scaling if it is None.

    The measuring process is stored, too.
    """
    import drjit as dr

    o = common.options
    select_backend(o.mode)
    repeats, samples = effort(o)

    def open_planned() -> StudySubject:
        scene, defaults = common.scene, {}
        if isinstance(scene, PlannedScene):
            scene, defaults = scene.checked_path(), scene.defaults
        return open_subject(str(scene), o.scene_kind, o.width, o.height, defaults, find_reference_scene)

    # Its reference may take longer than its settings.
    subject = prepare_once(common, open_planned)
    if numbers is None:
        rows = study.measure_scaling(subject, min(repeats, 3), o.quick)
    else:
        every = list_rows(subject, o.quick)
        rows = study.measure_rows(subject, [every[k] for k in (0, *numbers)], repeats, samples)
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
