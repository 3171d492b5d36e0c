"""The evaluations that a report shows: those that were given, and those that are made for it."""

from __future__ import annotations

from collections.abc import Sequence

from nerg_mi.errors import NergError, plain
from nerg_mi.evaluation.gaze_report import GazeResults, read_results
from nerg_mi.files.atomic import file_sha256
from nerg_mi.jobs.evaluation import evaluate_gaze
from nerg_mi.jobs.options.evaluation import GazeEvaluationOptions
from nerg_mi.jobs.options.report import ReportOptions
from nerg_mi.jobs.reporter import Reporter

from .files import ReportFiles


def given_results(given: ReportFiles) -> tuple[list[GazeResults], list[str]]:
    """The evaluations that were given, and doubts about them. Raises `NergError` for those of another field."""
    found, doubts, own = [], [], file_sha256(given.gaze)
    for path in given.results:
        results = read_results(path)
        if results.sha256 and results.sha256 != own:
            raise NergError(f'"{path}" is an evaluation of another gaze field than "{given.gaze}"; leave it out')
        if not results.sha256 and results.gaze != given.gaze.name:
            doubts.append(
                f"An evaluation is of a field called {plain(results.gaze, 80)}; whether it is this one is not known."
            )
        found.append(results)
    splits = [r.split for r in found]
    twice = next((s for s in splits if splits.count(s) > 1), None)
    if twice is not None:
        raise NergError(f'two of the evaluations are of the split "{plain(twice, 40)}"; leave out one of them')
    return found, doubts


def made_results(
    given: ReportFiles, options: ReportOptions, have: Sequence[GazeResults], reporter: Reporter
) -> list[GazeResults]:
    """Evaluations of the splits that there are and that nobody ``have``."""
    if given.rays is None:
        raise NergError("--evaluate scores the field on rays, and there are none; name the file that it was trained on")
    account = given.scene.about.get("test") or {}
    wanted = ("both", "pos", "people") if account.get("people") else ("pos",)
    place = {"field": "field", "scene": "scene", "hits": "geometry"}.get(given.scene.kind)
    where = {} if place is None else {place: given.scene.place}
    found = []
    for split in wanted:
        if split in {r.split for r in have}:
            continue
        more = {"threads": options.threads, "seed": options.seed, "mode": options.mode or "llvm_ad_rgb"}
        job = GazeEvaluationOptions(split=split, pictures=0, **where, **more)
        reporter.message(f"scoring the split {split}")
        scored = evaluate_gaze(given.gaze, given.rays, None, job, reporter)
        about = given.gaze.name, file_sha256(given.gaze), split, scored.positions, scored.people, job.kappa
        found.append(GazeResults(*about, tuple(scored.rows), tuple(scored.persons)))
    return found
