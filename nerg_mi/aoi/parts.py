"""A count in parts: rays and places shared out, what is run for each part, and sums taken in one order."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.files.atomic import replace_atomically
from nerg_mi.files.safe_read import read_npz
from nerg_mi.formats.areas import AreaSet, list_area_files, read_areas
from nerg_mi.formats.checkpoint import read_metadata
from nerg_mi.rays.dataset import DATASET_MANIFEST, RayDataset, is_dataset, read_dataset_manifest, read_source_manifest, source_manifest_path
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.scene import list_scene_files
from nerg_mi.statistics.visits import Cell, VisitSums
from nerg_mi.tasks.engines import prepare_once
from nerg_mi.tasks.task import RENDER_LIBRARIES, FileGroup, Part, Plan
from nerg_mi.workflows.base import select_backend
from nerg_mi.workflows.geometry import find_training_file, geometry_key
from nerg_mi.workflows.options import to_base
from nerg_mi.workflows.parts import PartRunner, PlannedScene

from .measured import AoiContext, Viewpoints, iter_blocks, count_block
from .options import CountOptions, PredictionOptions, AoiOptions, StatisticsOptions
from .predicted import AoiScene, PredictedAttention, load_aoi_scene
from .scene import files_of_changes, read_changes

# ---- What is run for a part ----


@dataclass(frozen=True)
class PlannedSetting:
    """What people look at, as a part finds it on any machine: ``options``, and the files of the place, of ``areas`` and
    of ``changes`` to them, where there are some."""

    options: AoiOptions
    scene: PlannedScene | None
    field: Path | None
    gaze: FileGroup | None
    areas: FileGroup
    changes: FileGroup | None = None

    def opened(self) -> AoiScene:
        """The setting, in its Mitsuba variant, after its changes."""
        ns = select_backend(self.options.mode)
        scene = None if self.scene is None else self.scene.checked_path()
        gaze = None if self.gaze is None else self.gaze.path
        setting = load_aoi_scene(scene, self.field, gaze, read_areas(self.areas.path), self.options, ns)
        return setting if self.changes is None else setting.apply_changes(read_changes(self.changes.path))


@dataclass(frozen=True)
class PlannedCount:
    """What all parts of a count have in common: rays end at their ``hits``, or not, and have these ``cohorts`` where no
    table does."""

    aoi_scene: PlannedSetting
    hits: bool
    cohorts: tuple[str, ...]

    def opened(self) -> AoiContext:
        """How rays are counted."""
        return self.aoi_scene.opened().make_context(self.hits, self.cohorts)


@dataclass(frozen=True)
class DatasetPart:
    """Those parts of a ``source`` of a dataset that have these ``numbers``; ``files``: the dataset's, as far as these
    need them."""

    files: FileGroup
    source: str
    numbers: tuple[int, ...]

    def opened(self) -> RayDataset:
        """The dataset that has these parts and no others."""
        folder = self.files.path
        head = read_dataset_manifest(folder)
        source = read_source_manifest(source_manifest_path(folder, self.source), head)
        parts = tuple((source, part) for part in source.parts if part.number in self.numbers)
        return RayDataset(folder, head, (source,), parts)


def count_part(common: PlannedCount, rays: Path | DatasetPart, output: Path) -> dict[str, int]:
    """The sums (.npz) of each block of some parts of a dataset, or of the rays of a file as one block, since they were
    cut already; with the number of blocks as a note."""
    counting = prepare_once(common, common.opened)
    blocks = [Rays.load(rays)] if isinstance(rays, Path) else iter_blocks(rays.opened(), counting.rules)
    sums = [count_block(block, counting) for block in blocks]
    write_sums(output, sums)
    return {"blocks": len(sums)}


@dataclass(frozen=True)
class PlannedPrediction:
    """What all parts of asking a field have in common: people see ``view`` degrees."""

    aoi_scene: PlannedSetting
    fov: float


@dataclass(frozen=True)
class ObserverPoses:
    """Where some people stand, ``positions`` (M, 3), and look ``ahead`` (M, 3)."""

    positions: np.ndarray
    facing: np.ndarray


OF_EYES = ("share", "distance", "visible", "support")
"""What is foretold of each eye, a row each; by the members of an ensemble apart it has an axis before that."""


def foretell_part(common: PlannedPrediction, places: ObserverPoses, output: Path) -> None:
    """What a field foretells (.npz) of people at some places."""
    setting: AoiScene = prepare_once(common, common.aoi_scene.opened)
    count = len(places.positions)
    eyes = Viewpoints(places.positions, places.facing, ("",) * count, (frozenset(),) * count)
    seen = setting.predict(eyes, common.fov)
    with replace_atomically(output) as temporary, temporary.open("wb") as out:
        np.savez(out, **{name: getattr(seen, name) for name in (*OF_EYES, "members")})


def write_sums(path: Path, found: list[VisitSums]) -> None:
    """Write sums one by one (.npz), so that whoever adds them does so in the order in which they were made."""
    arrays: dict[str, np.ndarray] = {}
    for k, sums in enumerate(found):
        cells = [asdict(cell) for cell in sums.cells]
        place = {cell: c for c, cell in enumerate(sums.cells)}
        rows = [(place[cell], person) for cell, person in sums.rows]
        arrays[f"{k}.names"] = np.array(json.dumps({"areas": sums.areas, "cells": cells, "rows": rows}))
        arrays |= {f"{k}.{name}": getattr(sums, name) for name in _ARRAYS}
    with replace_atomically(path) as temporary, temporary.open("wb") as out:
        np.savez(out, allow_pickle=False, **arrays)


def read_sums(path: Path) -> list[VisitSums]:
    """What `write_sums` has written."""
    arrays = read_npz(path, "part of a count")
    found = []
    for k in range(len(arrays) // (len(_ARRAYS) + 1)):
        names = json.loads(str(arrays[f"{k}.names"]))
        cells = tuple(Cell(**cell) for cell in names["cells"])
        rows = tuple((cells[c], person) for c, person in names["rows"])
        found.append(VisitSums(tuple(names["areas"]), cells, rows, **{name: arrays[f"{k}.{name}"] for name in _ARRAYS}))
    return found


def read_foretold(path: Path) -> PredictedAttention:
    """What `foretell_part` has written."""
    return PredictedAttention(**read_npz(path, "part of what a field foretells"))


_ARRAYS = tuple(f.name for f in fields(VisitSums) if f.name not in ("areas", "cells", "rows"))


# ---- Parts ----

VIEWPOINTS_PER_PART = 32  # places of a part from which a field is asked
_COUNTED = 0.6  # of all, where a field is asked too
_DONE = 0.8
_TOLD, _CHANGED = 0.9, 0.99  # when intervals are known, and after changes


@dataclass(frozen=True)
class PartitionedStatistics:
    """How a count is shared out: its ``parts``, ``what`` the job is called, and the files of its setting: ``scene``,
    ``field``, ``gaze`` and those of the ``options``, of which ``areas`` were read. ``mode``: the Mitsuba variant."""

    parts: PartRunner
    job_name: str
    scene: Path | None
    field: Path | None
    gaze: Path | None
    areas: AreaSet
    options: StatisticsOptions
    mode: str

    def count(
        self, rays: Rays | Path, context: AoiContext, on_block: Callable[[Rays], None] | None
    ) -> Iterator[VisitSums]:
        """The sums of each block of ``rays``, in the order of `blocks_of`. ``seen`` is shown each block before that, in
        the same order, where it is not None."""
        common = PlannedCount(self._setting(CountOptions), context.hits, context.cohort_names)
        with self.parts.store.make_scratch_folder() as folder:
            parts = []
            if not isinstance(rays, Rays) and is_dataset(rays):
                data = RayDataset.open(rays).require_single_place()
                for (source, part), own in _groups(data):
                    files = [data.folder / DATASET_MANIFEST, source_manifest_path(data.folder, source.id)]
                    files += [data.folder / p.path(source.id) for _, p in own]
                    value = DatasetPart(FileGroup(data.folder, tuple(files)), source.id, tuple(p.number for _, p in own))
                    parts.append(Part(value, f"{source.file}, {part.day}, bucket {part.bucket}"))
                if on_block is not None:
                    for block in iter_blocks(data, context.rules):
                        on_block(block)
            else:
                first = 1
                for block in iter_blocks(rays, context.rules):
                    if on_block is not None:
                        on_block(block)
                    # Rays that the command has in memory, in files that its parts read.
                    path = folder / str(first) / "rays.npz"
                    _own(block).save(path)
                    parts.append(Part(path, f"rays {first:,} to {first + len(block) - 1:,}"))
                    first += len(block)
            until = _DONE if on_block is None else _COUNTED
            for made in self.parts.run(self._plan(self.job_name, count_part, common, parts), 0.0, until):
                yield from read_sums(made.path)

    def predict(self, viewpoints: Viewpoints, fov: float, changes: Path | None = None) -> PredictedAttention:
        """What the field says of ``eyes`` that see ``view`` degrees, after the ``changes`` of a file, if there are
        any."""
        setting, what, since, until = self._setting(PredictionOptions), f"{self.job_name} (the field)", _COUNTED, _DONE
        if changes is not None:
            files = FileGroup(changes, tuple(files_of_changes(changes, read_changes(changes))))
            setting, what = replace(setting, changes=files), f"{self.job_name} (after the changes)"
            since, until = _TOLD, _CHANGED
        places = []
        for a in range(0, len(viewpoints.positions), VIEWPOINTS_PER_PART):
            some = ObserverPoses(viewpoints.positions[a : a + VIEWPOINTS_PER_PART], viewpoints.ahead[a : a + VIEWPOINTS_PER_PART])
            places.append(Part(some, f"places {a + 1} to {a + len(some.positions)}"))
        plan = self._plan(what, foretell_part, PlannedPrediction(setting, fov), places)
        found = [read_foretold(made.path) for made in self.parts.run(plan, since, until)]
        each = {name: np.concatenate([getattr(f, name) for f in found]) for name in OF_EYES}
        return PredictedAttention(**each, members=np.concatenate([f.members for f in found], axis=1))

    def _plan(self, what: str, work: Callable, common: Any, parts: list[Part]) -> Plan:
        return Plan(what, work, common, parts, ".npz", (*RENDER_LIBRARIES, "scipy"))

    def _setting(self, kind: type[CountOptions] | type[PredictionOptions]) -> PlannedSetting:
        """The setting, with those options of ``kind``."""
        o, gaze = self.options, None
        assert o.aois is not None
        if self.gaze is not None:
            beside = [] if self.scene is not None else _place_beside(self.gaze, self.field)
            gaze = FileGroup(self.gaze, (self.gaze, *beside))
        return PlannedSetting(
            replace(to_base(o, kind), mode=self.mode),
            None if self.scene is None else PlannedScene.plan(self.scene),
            self.field,
            gaze,
            FileGroup(o.aois, tuple(list_area_files(o.aois, self.areas))),
        )


def _own(block: Rays) -> Rays:
    """A block with nothing in it of whom and of what it does not hold."""
    used = np.unique(block.person)
    return replace(
        block,
        person=np.searchsorted(used, block.person).astype(np.int32),
        persons=tuple(block.persons[k] for k in used.tolist()),
        metadata={"frame": block.metadata["frame"]},
    )


def _groups(data: RayDataset) -> Iterator[tuple]:
    """The parts of a dataset that `blocks_of` may cut through, one after the other, each with its first."""
    for _, group in groupby(data.parts, key=lambda p: (p[0].id, p[1].day, p[1].bucket)):
        own = list(group)
        yield own[0], own


def _place_beside(gaze: Path, field: Path | None) -> list[Path]:
    """The files of the place that a gaze field was trained in, as far as they lie beside it."""
    about = read_metadata(gaze).get("provenance", {})
    if about.get("geometry") == "none":
        return []
    if field is not None and geometry_key(gaze, about) == "field_file":
        return []
    path = find_training_file(gaze, about, None, "put it there", "put that one there")
    return list_scene_files(path) if path.suffix.lower() == ".xml" else [path]
