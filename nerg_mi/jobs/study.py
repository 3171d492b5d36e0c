"""``nerg study``: Measure error against run time: a scene at many settings, compared with what is true.

The study of error against run time: a scene at many settings, each compared with what is true.
"""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.errors import NergError
from nerg_mi.evaluation import study, study_tables, study_truth
from nerg_mi.evaluation.study import Setting, settings
from nerg_mi.evaluation.study_subject import Subject, open_subject
from nerg_mi.figures.style import Provenance, files_among, provenance
from nerg_mi.files.atomic import check_folder
from nerg_mi.rendering.pictures import activate
from nerg_mi.rendering.scene_file import files_of_scene

from .commands import argument, command, extra
from .options.study import StudyOptions
from .reporter import SILENT, Reporter
from .study_tasks import measured_in_parts, twin_beside
from .versions import versions


@dataclass(frozen=True)
class StudyResult:
    """``files`` written; ``report``: what study.json holds, ``rows`` and ``against_paper`` in it."""

    files: list[Path]
    report: dict


@command(
    "study",
    "Measure error against run time: render a scene at many settings, compare each with what is true, and plot it.",
    more="""Writes study.csv (a row a setting), study.md (the same by factor), scaling.csv, study.json and two plots. A
full study takes up to half an hour.""",
    options=StudyOptions,
    scene=argument("Scene file (.xml), or slab, sphere, sheets, fog or ramp.", str),
    out=extra(..., "Folder to write into; it is made.", Path, "-o", "--out"),
)
def run_study(
    scene: str | Path, out: str | Path, options: StudyOptions | None = None, reporter: Reporter = SILENT
) -> StudyResult:
    """Study ``scene``, a scene file or the name of an analytic scene, and write tables and plots into the folder
    ``out``: study.csv (a row a setting), study.md (the same by factor), scaling.csv, study.json and two plots. With
    ``options.store`` or ``options.scheduler`` a few settings are a part, which is kept and may be measured by others:
    errors are the same, and times those of whoever took them, with that one's time of the default beside them.

    Raises `NergError` for what the user can mend, before anything is written.
    """
    options = options or StudyOptions()
    width, height = options.width, options.height
    if min(width, height) < 4 or options.repeats < 1:
        raise NergError(
            "a study needs pictures of at least 4 x 4 pixels and one timed render, "
            f"got {width} x {height} and {options.repeats}"
        )
    wanted = _expression(options.only)
    out = Path(out)
    check_folder(out)
    mode = activate(options.mode)
    import drjit as dr

    begin = time.perf_counter()
    reporter.progress(0.0, "open")
    subject = open_subject(str(scene), options.scene_kind, width, height, options.defaults, twin_beside)
    rows = _chosen(settings(subject, options.quick), wanted, options.only)
    repeats, samples = (1, 16) if options.quick else (options.repeats, study.PIXEL_SPP)
    timed_by: list[dict] = []
    done = 0

    def step(name: str) -> None:
        nonlocal done
        # The rows' first renders and their times, and the scaling, which is about a tenth of it.
        reporter.progress(min(done / (2.2 * len(rows)), 0.99), name)
        done += 1

    if options.in_parts:
        numbers = (repeats, samples)
        table, scaling, timed_by = measured_in_parts(subject, scene, out, rows, numbers, mode, options, reporter)
    else:
        table = study.measure(subject, rows, repeats, samples, step)
        scaling = study.scaling(subject, min(repeats, 3), options.quick, step)
    study_tables.mark_fronts(table)
    known = subject.truth(study.SEED, "expected", "depth")
    report = {
        "scene": subject.name,
        "variant": mode,
        "size": [width, height],
        "extent": subject.extent,
        "step": subject.step,
        "tolerance": subject.tolerance,
        "reference": known.source,
        "reference_change_when_step_halved": known.convergence,
        "precision": study.precision(),
        "gaze_kld_eps": study_truth.KLD_EPS,
        "repeats": repeats,
        "threads": timed_by[0]["threads"] if timed_by else dr.thread_count(),
        "timed_by": timed_by,
        "peak_mb": "what Dr.Jit allocated at most during a first render, in MiB, beyond scene and field",
        "seconds_of_study": time.perf_counter() - begin,
        "versions": versions(mode),
        "against_paper": study_tables.against_paper(table),
        "rows": table,
        "scaling": scaling,
    }
    sources = files_of_scene(scene, options.defaults) if files_among(scene) else []
    files = _write(out, subject, report, provenance("nerg study", sources, study.SEED, options))
    for line in study_tables.summary(report):
        reporter.message(line)
    for path in files:
        reporter.message(f"wrote {path}")
    return StudyResult(files, report)


def _expression(only: str) -> re.Pattern:
    try:
        return re.compile(only)
    except re.error as error:
        raise NergError(f'"{only}" is no regular expression ({error}): name settings as in "depth|paper"') from error


def _chosen(all_settings: list[Setting], wanted: re.Pattern, only: str) -> list[Setting]:
    """The first of the settings, which is the default, and those whose names match."""
    default, *others = all_settings
    rows = [default, *(row for row in others if wanted.search(row.name))]
    if only and len(rows) == 1:
        raise NergError(
            f'no setting matches "{only}"; their names are those of an earlier study.csv, such as "{others[0].name}"'
        )
    return rows


def _write(out: Path, subject: Subject, report: dict, about: Provenance) -> list[Path]:
    files = study_tables.write_tables(out, report)
    width, height = report["size"]
    title = f"{subject.name}, {width} x {height}, {report['variant']}"
    study_tables.plot_errors(out / "errors.png", report["rows"], f"Error against time: {title}", about)
    study_tables.plot_scaling(out / "scaling.png", report["scaling"], f"Cost of the default: {title}", about)
    return [*files, out / "errors.png", out / "scaling.png"]
