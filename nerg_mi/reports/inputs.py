"""Inputs of a report: a gaze field, its environment, rays and evaluations, in any order, in memory or as files."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerg_mi.environment.gaze import GazeField
from nerg_mi.environment.inputs import sort_inputs
from nerg_mi.environment.kinds import KINDS
from nerg_mi.errors import MissingFile, NergError, parameter, sanitize
from nerg_mi.evaluation.gaze_report import GazeResults, read_results
from nerg_mi.evaluation.held_out import GazeEvaluation, evaluate_gaze
from nerg_mi.files.atomic import file_sha256
from nerg_mi.files.safe_read import resolve_path
from nerg_mi.files.values import FilePath
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.tracking.dataset import is_dataset, open_rays
from nerg_mi.tracking.rays import Rays

RESULTS = "gaze.json"
"""Name of the file with the results of an evaluation."""


@dataclass(frozen=True, eq=False)
class ReportInputs:
    """Inputs of a report.

    ``environment`` is an object or a file, or None: that of the training. ``rays`` are in memory, a file or a dataset,
    or None. ``evaluations`` are in memory or files.
    """

    gaze: GazeField
    environment: Any
    rays: Rays | FilePath | None
    evaluations: tuple[GazeEvaluation | Path, ...]

    def load_rays(self) -> Rays | None:
        """Return the rays; of a dataset, the sample of the training."""
        if self.rays is None:
            return None
        trained = self.gaze.provenance.get("rays_file", {})
        return open_rays(self.rays, trained.get("most"), trained.get("seed", 0))


def open_inputs(inputs: Any, reporter: Reporter = SILENT) -> ReportInputs:
    """Recognise one input or several in any order: a gaze field, its environment, rays, and evaluations (as returned by
    `evaluate_gaze`, ``gaze.json``, or its folder).

    Other folders are replaced by the files in them. Without an evaluation, that which `nerg eval gaze` has written next
    to the gaze field is used, if it is of this field. Raises `NergError` for what does not make a report.
    """
    # A file that is named, and in a folder that is named, is one input.
    items: dict[Any, Any] = {}
    evaluations: list[GazeEvaluation | Path] = []
    for item in _expand_folders(inputs if isinstance(inputs, (list, tuple)) else [inputs]):
        if isinstance(item, GazeEvaluation) or (isinstance(item, Path) and item.suffix.lower() == ".json"):
            evaluations.append(item)
        else:
            items.setdefault(resolve_path(item) if isinstance(item, Path) else id(item), item)
    chosen = sort_inputs(list(items.values()))
    if chosen.gaze is None:
        raise NergError("a report needs a gaze field, and there is none among these inputs; name its checkpoint")
    gaze = GazeField.open(chosen.gaze)
    if not evaluations and gaze.path is not None:
        evaluations = _find_results(gaze.path, reporter)
    return ReportInputs(gaze, chosen.environment, chosen.rays, tuple(evaluations))


def _expand_folders(inputs: Sequence[Any]) -> Iterator[Any]:
    """Yield ``inputs``, with paths as `Path`, and folders replaced by the files in them."""
    for item in inputs:
        if not isinstance(item, (str, os.PathLike)):
            yield item
            continue
        path = Path(item)
        if not path.exists():
            raise MissingFile(f'there is no file or folder "{path}"; correct its name')
        if not path.is_dir() or is_dataset(path):
            yield path
        elif (path / RESULTS).is_file():
            yield path / RESULTS
        else:
            yield from _list_inputs(path)


def _list_inputs(folder: Path) -> list[Path]:
    """Return checkpoints, rays and evaluations in a folder, sorted by name."""
    entries = sorted(folder.iterdir())
    selected = [p for p in entries if p.suffix.lower() == ".safetensors" and p.is_file()]
    selected += [p for p in entries if KINDS.get(p.suffix.lower()) == "rays" and (p.is_file() or is_dataset(p))]
    selected += [p / RESULTS for p in entries if p.is_dir() and (p / RESULTS).is_file()]
    if not selected:
        raise NergError(f'the folder "{folder}" contains no checkpoint, rays or evaluation; name another one')
    return selected


# ---- Evaluations: given, next to the gaze field, and those that are computed ----


def _find_results(gaze: Path, reporter: Reporter) -> list[GazeEvaluation | Path]:
    """Return the evaluation that `nerg eval gaze` has written next to the checkpoint ``gaze``, if it is of this one."""
    path = gaze.with_suffix(".eval") / RESULTS
    if not path.is_file():
        return []
    if read_results(path).sha256 not in ("", file_sha256(gaze)):
        reporter.warn(f'"{path}" is not used: "{gaze.name}" was trained again since; run nerg eval gaze')
        return []
    reporter.message(f"the evaluation is {path}")
    return [path]


def open_evaluations(inputs: ReportInputs) -> tuple[list[GazeResults], list[str]]:
    """Return the results of the evaluations among ``inputs``, and doubts. Raises `NergError` for those of another
    field."""
    gaze, opened, doubts = inputs.gaze, list[GazeResults](), list[str]()
    sha256 = None if gaze.path is None else file_sha256(gaze.path)
    for evaluation in inputs.evaluations:
        if isinstance(evaluation, GazeEvaluation):
            opened.append(_list_results(evaluation, gaze))
            continue
        results = read_results(evaluation)
        if results.sha256 and sha256 is not None and results.sha256 != sha256:
            raise NergError(f'"{evaluation}" is an evaluation of a gaze field other than {gaze.label}; leave it out')
        if not (results.sha256 and sha256 is not None) and results.gaze != gaze.name:
            doubts.append(f"An evaluation is of a field named {sanitize(results.gaze, 80)}, which may be another one.")
        opened.append(results)
    splits = [r.split for r in opened]
    twice = next((s for s in splits if splits.count(s) > 1), None)
    if twice is not None:
        raise NergError(f'two evaluations are of the split "{sanitize(twice, 40)}"; leave out one of them')
    return opened, doubts


def _list_results(evaluation: GazeEvaluation, gaze: GazeField) -> GazeResults:
    """Return the results of an evaluation of ``gaze``."""
    sha256 = "" if gaze.path is None else file_sha256(gaze.path)
    scores = tuple(evaluation.rows), tuple(evaluation.persons), evaluation.split_half_note
    counts = evaluation.positions, evaluation.people, evaluation.kappa
    return GazeResults(gaze.name, sha256, evaluation.split, *counts, *scores)


def compute_evaluations(
    inputs: ReportInputs, seed: int, have: Sequence[GazeResults], reporter: Reporter
) -> list[GazeResults]:
    """Compute the evaluations of the splits that are not in ``have``."""
    if inputs.rays is None:
        raise NergError(f"{parameter('evaluate', True)} needs the rays of the training; name their file")
    test = inputs.gaze.provenance.get("test") or {}
    splits = ("both", "pos", "people") if test.get("people") else ("pos",)
    evaluations = []
    for split in splits:
        if split in {r.split for r in have}:
            continue
        reporter.message(f"scoring the split {split}")
        settings: dict[str, Any] = {"split": split, "pictures": 0, "seed": seed, "progress": SILENT}
        scored = evaluate_gaze(inputs.gaze, inputs.rays, inputs.environment, **settings)
        evaluations.append(_list_results(scored, inputs.gaze))
    return evaluations
