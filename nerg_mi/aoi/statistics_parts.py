"""Partitioned AOI statistics: parts of samples and viewpoints, the work of each part, and sums in a fixed order."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.environment.environment import Environment
from nerg_mi.environment.gaze import GazeField
from nerg_mi.environment.planned import PlannedFiles
from nerg_mi.environment.scene_loading import activate_mitsuba, activate_variant, list_scene_files
from nerg_mi.files.atomic import replace_atomically
from nerg_mi.files.safe_read import read_npz
from nerg_mi.tasks.execution import prepare_once
from nerg_mi.tasks.parts import PartRunner
from nerg_mi.tasks.task import RENDER_LIBRARIES, FileGroup, Part, Plan
from nerg_mi.tracking.dataset import (
    DATASET_MANIFEST,
    RayDataset,
    read_dataset_manifest,
    read_source_manifest,
    source_manifest_path,
)
from nerg_mi.tracking.rays import Rays

from .areas import Areas
from .changes import Changes, apply_changes, list_change_files, open_changes, read_changes
from .measured import AoiContext, Counting, count_block, iter_blocks
from .placed import PlacedAreas, open_placed_areas
from .predicted import PredictedAttention, Viewpoints, predict_attention
from .settings import AoiSampling
from .visits import Cell, VisitSums

# ---- Work of a part ----


@dataclass(frozen=True)
class PlannedAreas:
    """Files and settings of `PlacedAreas`, from which a part creates it on any machine. Areas and changes may be in
    memory, and ``align`` is a file or a matrix."""

    environment: PlannedFiles | None
    gaze: FileGroup | None
    areas: FileGroup | Areas
    align: Path | list[list[float]] | None
    sampling: AoiSampling
    mode: str
    changes: FileGroup | Changes | None = None

    def open(self) -> PlacedAreas:
        """Load the files in the Mitsuba variant, and apply the changes."""
        activate_variant(self.mode)
        environment = None if self.environment is None else self.environment.checked_path()
        gaze = None if self.gaze is None else self.gaze.path
        areas = Areas.load(self.areas.path) if isinstance(self.areas, FileGroup) else self.areas
        placed = open_placed_areas(environment, gaze, areas, self.align, self.sampling)
        changes = read_changes(self.changes.path) if isinstance(self.changes, FileGroup) else self.changes
        return placed if changes is None else apply_changes(placed, changes)


@dataclass(frozen=True)
class PlannedCount:
    """Common arguments of all parts of a count, see `AoiContext`."""

    areas: PlannedAreas
    counting: Counting
    use_hit_points: bool
    cohorts: tuple[str, ...]

    def open(self) -> AoiContext:
        """Create the context of the count."""
        return AoiContext(self.areas.open(), self.counting, self.use_hit_points, self.cohorts)


@dataclass(frozen=True)
class DatasetPart:
    """The numbered parts of one ``source`` of a dataset, with the dataset's ``files`` that they need."""

    files: FileGroup
    source: str
    numbers: tuple[int, ...]

    def open(self) -> RayDataset:
        """Open a dataset that consists of these parts."""
        folder = self.files.path
        head = read_dataset_manifest(folder)
        source = read_source_manifest(source_manifest_path(folder, self.source), head)
        parts = tuple((source, part) for part in source.parts if part.number in self.numbers)
        return RayDataset(folder, head, (source,), parts)


def count_part(common: PlannedCount, rays: Path | DatasetPart, output: Path) -> dict[str, int]:
    """Write the sums (.npz) of each block of some parts of a dataset, or of a file of samples as one block. Return
    the number of blocks."""
    context = prepare_once(common, common.open)
    blocks = [Rays.load(rays)] if isinstance(rays, Path) else iter_blocks(rays.open(), context.counting.rules)
    sums = [count_block(block, context) for block in blocks]
    write_sums(output, sums)
    return {"blocks": len(sums)}


@dataclass(frozen=True)
class PlannedPrediction:
    """Common arguments of all parts of a prediction."""

    areas: PlannedAreas
    fov: float
    sigma: float = 0.0


@dataclass(frozen=True)
class ObserverPoses:
    """``positions`` and ``facing`` directions of M observers, (M, 3) each."""

    positions: np.ndarray
    facing: np.ndarray

    def to_viewpoints(self) -> Viewpoints:
        """Return viewpoints of nobody."""
        count = len(self.positions)
        return Viewpoints(self.positions, self.facing, ("",) * count, (frozenset(),) * count)


VIEWPOINT_ARRAYS = ("share", "distance", "visible", "support")
"""Arrays of a prediction with one row per viewpoint. ``members`` and ``disturbed`` have an additional first axis."""


def predict_part(common: PlannedPrediction, poses: ObserverPoses, output: Path) -> None:
    """Write the predicted attention (.npz) of some observers."""
    placed: PlacedAreas = prepare_once(common, common.areas.open)
    write_prediction(output, predict_attention(placed, poses.to_viewpoints(), common.fov, sigma=common.sigma))


def write_prediction(path: Path, predicted: PredictedAttention) -> None:
    """Write a prediction (.npz), as `read_prediction` reads it."""
    names = (*VIEWPOINT_ARRAYS, "members", *([] if predicted.disturbed is None else ["disturbed"]))
    with replace_atomically(path) as temporary, temporary.open("wb") as out:
        np.savez(out, **{name: getattr(predicted, name) for name in names})


def write_sums(path: Path, sums_of_blocks: list[VisitSums]) -> None:
    """Write the sums of several blocks (.npz) separately, so that they can be added in the order of the blocks."""
    arrays: dict[str, np.ndarray] = {}
    for k, sums in enumerate(sums_of_blocks):
        cells = [asdict(cell) for cell in sums.cells]
        cell_index = {cell: c for c, cell in enumerate(sums.cells)}
        rows = [(cell_index[cell], person) for cell, person in sums.rows]
        arrays[f"{k}.names"] = np.array(json.dumps({"areas": sums.areas, "cells": cells, "rows": rows}))
        arrays |= {f"{k}.{name}": getattr(sums, name) for name in _ARRAYS}
    with replace_atomically(path) as temporary, temporary.open("wb") as out:
        np.savez(out, allow_pickle=False, **arrays)


def read_sums(path: Path) -> list[VisitSums]:
    """Read sums written by `write_sums`."""
    arrays = read_npz(path, "partial AOI statistics")
    sums = []
    for k in range(len(arrays) // (len(_ARRAYS) + 1)):
        names = json.loads(str(arrays[f"{k}.names"]))
        cells = tuple(Cell(**cell) for cell in names["cells"])
        rows = tuple((cells[c], person) for c, person in names["rows"])
        sums.append(VisitSums(tuple(names["areas"]), cells, rows, **{name: arrays[f"{k}.{name}"] for name in _ARRAYS}))
    return sums


def read_prediction(path: Path) -> PredictedAttention:
    """Read a prediction written by `predict_part`."""
    return PredictedAttention(**read_npz(path, "partial prediction"), note="")


_ARRAYS = tuple(f.name for f in fields(VisitSums) if f.name not in ("areas", "cells", "rows"))


# ---- Parts ----

VIEWPOINTS_PER_PART = 32  # number of viewpoints per part of a prediction
_PROGRESS_COUNTED = 0.6  # progress after the count, if a prediction follows
_PROGRESS_PREDICTED = 0.8
_PROGRESS_INTERVALS, _PROGRESS_WHAT_IF = 0.9, 0.99  # progress after intervals and after the what-if analysis


@dataclass(frozen=True)
class PartitionedStatistics:
    """AOI statistics computed in parts.

    Parameters
    ----------
    parts
        Runs the parts.
    job_name
        Name of the job.
    environment, gaze
        Files, see `save_objects`.
    areas
        AOIs.
    align
        File or matrix of a similarity, or None.
    sampling
        How rays are assigned to AOIs, and how visibility and the gaze field are sampled.
    """

    parts: PartRunner
    job_name: str
    environment: Path | None
    gaze: Path | None
    areas: Areas
    align: Path | list[list[float]] | None
    sampling: AoiSampling

    def count(
        self, rays: Rays | RayDataset, context: AoiContext, on_block: Callable[[Rays], None] | None
    ) -> Iterator[VisitSums]:
        """Yield the sums of each block of samples, in the order of `iter_blocks`. ``on_block`` is called with each
        block before, in the same order."""
        common = PlannedCount(
            self.plan_areas("tolerance", "margin", "aoi_samples", "cell_size"),
            context.counting,
            context.use_hit_points,
            context.cohort_names,
        )
        with self.parts.store.make_scratch_folder() as folder:
            parts = []
            if isinstance(rays, RayDataset):
                data = rays.require_single_place()
                # Consecutive parts whose sessions `iter_blocks` may join.
                for _, parts_of_sessions in groupby(data.parts, key=lambda p: (p[0].id, p[1].day, p[1].bucket)):
                    group = list(parts_of_sessions)
                    source, part = group[0]
                    files = [data.folder / DATASET_MANIFEST, source_manifest_path(data.folder, source.id)]
                    files += [data.folder / p.path(source.id) for _, p in group]
                    value = DatasetPart(
                        FileGroup(data.folder, tuple(files)), source.id, tuple(p.number for _, p in group)
                    )
                    parts.append(Part(value, f"{source.file}, {part.day}, bucket {part.bucket}"))
                if on_block is not None:
                    for block in iter_blocks(data, context.counting.rules):
                        on_block(block)
            else:
                first = 1
                for block in iter_blocks(rays, context.counting.rules):
                    if on_block is not None:
                        on_block(block)
                    # Parts read the samples from files.
                    path = folder / str(first) / "rays.npz"
                    _drop_unused(block).save(path)
                    parts.append(Part(path, f"samples {first:,} to {first + len(block) - 1:,}"))
                    first += len(block)
            end = _PROGRESS_PREDICTED if on_block is None else _PROGRESS_COUNTED
            for output in self.parts.run(self.make_plan(self.job_name, count_part, common, parts), 0.0, end):
                yield from read_sums(output.path)

    def predict(
        self, viewpoints: Viewpoints, fov: float, changes: Any = None, *, sigma: float = 0.0
    ) -> PredictedAttention:
        """Predict the attention of ``viewpoints`` with a field of view of ``fov`` degrees, after ``changes``, those of
        a file or a dict; ``sigma`` is that of `predict_attention`."""
        areas, job_name = self.plan_areas("margin", "aoi_samples", "directions"), f"{self.job_name} (prediction)"
        start, end = _PROGRESS_COUNTED, _PROGRESS_PREDICTED
        if changes is not None:
            planned = opened = open_changes(changes)
            if isinstance(changes, Path):
                planned = FileGroup(changes, tuple(list_change_files(changes, opened)))
            areas, job_name = replace(areas, changes=planned), f"{self.job_name} (what-if)"
            start, end = _PROGRESS_INTERVALS, _PROGRESS_WHAT_IF
        parts = []
        for a in range(0, len(viewpoints.positions), VIEWPOINTS_PER_PART):
            poses = ObserverPoses(
                viewpoints.positions[a : a + VIEWPOINTS_PER_PART], viewpoints.facing[a : a + VIEWPOINTS_PER_PART]
            )
            parts.append(Part(poses, f"viewpoints {a + 1} to {a + len(poses.positions)}"))
        plan = self.make_plan(job_name, predict_part, PlannedPrediction(areas, fov, sigma), parts)
        predictions = [read_prediction(output.path) for output in self.parts.run(plan, start, end)]
        arrays = {name: np.concatenate([getattr(f, name) for f in predictions]) for name in VIEWPOINT_ARRAYS}
        members = np.concatenate([f.members for f in predictions], axis=1)
        levels = [f.disturbed for f in predictions if f.disturbed is not None]
        disturbed = np.concatenate(levels, axis=1) if levels else None
        return PredictedAttention(**arrays, members=members, note="", disturbed=disturbed)

    def make_plan(self, job_name: str, work: Callable, common: Any, parts: list[Part]) -> Plan:
        """Plan ``parts`` that ``work`` computes."""
        return Plan(job_name, work, common, parts, ".npz", (*RENDER_LIBRARIES, "scipy"))

    def plan_areas(self, *names: str) -> PlannedAreas:
        """Plan the areas with the values of the sampling that affect the result, by ``names``."""
        environment, gaze = self.environment, None
        if self.gaze is not None:
            geometry_files = [] if environment is not None else _geometry_files(self.gaze)
            gaze = FileGroup(self.gaze, (self.gaze, *geometry_files))
        areas = self.areas if self.areas.path is None else FileGroup(self.areas.path, self.areas.files)
        sampling = AoiSampling(**{name: getattr(self.sampling, name) for name in names})
        mode = str(activate_mitsuba().variant())
        planned = None if environment is None else PlannedFiles.plan(environment)
        return PlannedAreas(planned, gaze, areas, self.align, sampling, mode)


def save_objects(environment: Any, gaze: Any, folder: Path) -> tuple[Path | None, Path | None]:
    """Return the files of an environment and of a gaze field for parts; what is in memory is written to ``folder``."""
    if environment is not None and not isinstance(environment, Path):
        environment = Environment.open(environment).save(folder / "environment").path
    if gaze is not None and not isinstance(gaze, Path):
        gaze = GazeField.open(gaze).save(folder / "gaze.safetensors")
    return environment, gaze


def _drop_unused(block: Rays) -> Rays:
    """Drop participants and metadata that the block does not use."""
    used = np.unique(block.person)
    return replace(
        block,
        person=np.searchsorted(used, block.person).astype(np.int32),
        persons=tuple(block.persons[k] for k in used.tolist()),
        metadata={"frame": block.metadata["frame"]},
    )


def _geometry_files(gaze: Path) -> list[Path]:
    """Return the geometry files next to a gaze field that it was trained with."""
    field = GazeField.open(gaze)
    if field.provenance.get("geometry") == "none":
        return []
    return list_scene_files(field.find_environment_file())
