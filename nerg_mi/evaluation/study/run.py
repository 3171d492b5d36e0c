"""The study of error against run time: a scene at many settings, each compared with what is true."""

from __future__ import annotations

import platform
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from nerg_mi import __version__
from nerg_mi.errors import NergError
from nerg_mi.files.atomic import check_folder
from nerg_mi.rendering.pictures import activate

from . import errors as study_errors
from . import measure as study_measure
from . import plots as study_plots
from . import tables as study_tables
from .settings import settings
from .subject import open_subject

WIDTH, HEIGHT = 192, 128


@dataclass(frozen=True)
class StudyResult:
    """``files`` written; ``report``: what study.json holds, ``rows`` and ``against_paper`` in it."""

    files: list[Path]
    report: dict


def run_study(
    scene: str,
    out: str | Path,
    *,
    kind: str = "auto",
    width: int = WIDTH,
    height: int = HEIGHT,
    repeats: int = 5,
    quick: bool = False,
    only: str = "",
    defaults: Mapping[str, str] | None = None,
    variant: str | None = None,
    on_step: Callable[[str, float], None] = lambda name, share: None,
) -> StudyResult:
    """Study ``scene`` (a scene file, or the name of an analytic scene) and write tables and plots into the folder
    ``out``.

    ``kind``: see `study_subject.KINDS`; ``width``, ``height`` in pixels; ``repeats``: timed renders of each setting;
    ``quick``: few settings, timed once; ``only``: regular expression that the names of further settings than the
    default match; ``defaults``: of a scene file; ``on_step`` is told what is done and the share done
    so far. Raises NergError for what the user can mend.
    """
    if min(width, height) < 4 or repeats < 1:
        raise NergError(
            f"a study needs pictures of at least 4 x 4 pixels and one timed render, got {width} x {height} and {repeats}."
        )
    try:
        wanted = re.compile(only)
    except re.error as error:
        raise NergError(f'"{only}" is no regular expression ({error}): name settings as in "depth|paper".') from error
    out = Path(out)
    check_folder(out)
    active = activate(variant)
    import drjit as dr
    import mitsuba as mi

    begin = time.perf_counter()
    on_step("open", 0.0)
    subject = open_subject(scene, kind, width, height, defaults)
    default, *others = settings(subject, quick)
    rows = [default, *(row for row in others if wanted.search(row.name))]
    if only and len(rows) == 1:
        raise NergError(
            f'no setting matches "{only}"; their names are those of an earlier study.csv, such as "{others[0].name}".'
        )
    repeats = 1 if quick else repeats
    done = 0

    def step(name):
        nonlocal done
        # The rows' first renders and their times, and the scaling, which is about a tenth of it.
        on_step(name, min(done / (2.2 * len(rows)), 0.99))
        done += 1

    table = study_measure.measure(subject, rows, repeats, 16 if quick else study_measure.PIXEL_SPP, step)
    study_tables.mark_fronts(table)
    scaling = study_measure.scaling(subject, min(repeats, 3), quick, step)
    known = subject.truth(study_measure.SEED, "expected", "depth")
    report = {
        "scene": subject.name,
        "variant": active,
        "size": [width, height],
        "extent": subject.extent,
        "step": subject.step,
        "tolerance": subject.tolerance,
        "reference": known.source,
        "reference_change_when_step_halved": known.convergence,
        "precision": study_measure.precision(),
        "gaze_kld_eps": study_errors.KLD_EPS,
        "repeats": repeats,
        "threads": dr.thread_count(),
        "peak_mb": "what Dr.Jit allocated at most during a first render, in MiB, beyond scene and field",
        "seconds_of_study": time.perf_counter() - begin,
        "versions": {
            "nerg_mi": __version__,
            "mitsuba": mi.__version__,
            "drjit": dr.__version__,
            "python": platform.python_version(),
        },
        "against_paper": study_tables.against_paper(table),
        "rows": table,
        "scaling": scaling,
    }
    files = study_tables.write_tables(out, report)
    title = f"{subject.name}, {width} x {height}, {active}"
    study_plots.plot_errors(out / "errors.png", table, f"Error against time: {title}")
    study_plots.plot_scaling(out / "scaling.png", scaling, f"Cost of the default: {title}")
    return StudyResult([*files, out / "errors.png", out / "scaling.png"], report)
