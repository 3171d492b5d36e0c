"""A count in parts, wherever they are made: rays and places shared out, sums taken in one order."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np

from nerg_mi.formats.areas.kinds import Areas
from nerg_mi.formats.areas.reading import files_of_areas
from nerg_mi.formats.checkpoint import read_metadata
from nerg_mi.jobs.gaze_places import file_of_training, place_key
from nerg_mi.jobs.options.statistics import StatisticsOptions
from nerg_mi.jobs.parts import Parts
from nerg_mi.rays.dataset.dataset import RayDataset
from nerg_mi.rays.dataset.layout import HEAD, is_dataset
from nerg_mi.rays.dataset.manifest import source_path
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.scene_file import files_of_scene
from nerg_mi.statistics.visits import Sums
from nerg_mi.tasks.code import RENDERS, versions
from nerg_mi.tasks.inputs import Checksums, InputFile, name_of, read_inputs
from nerg_mi.tasks.plan import Plan
from nerg_mi.tasks.task import Task

from .changes import files_of_changes, read_changes
from .foretold import Foretold
from .tasks import OF_COUNTS, OF_EYES, OF_FIELDS, RAYS, count_part, described, foretell_part, read_foretold, read_sums
from .tracked import Counting, Eyes, blocks_of

EYES = 32
"""Places of a part from which a field is asked."""

_COUNTED = 0.6  # of all, where a field is asked too
_DONE = 0.8
_TOLD, _CHANGED = 0.9, 0.99  # when intervals are known, and after changes


@dataclass(frozen=True)
class CountingParts:
    """How a count is shared out: its ``parts``, ``what`` the job is called, and the files of its setting: ``scene``,
    ``field``, ``gaze`` and those of the ``options``, of which ``areas`` were read. ``mode``: the Mitsuba variant."""

    parts: Parts
    what: str
    scene: Path | None
    field: Path | None
    gaze: Path | None
    areas: Areas
    options: StatisticsOptions
    mode: str

    def count(self, rays: Rays | Path, counting: Counting, seen: Callable[[Rays], None] | None) -> Iterator[Sums]:
        """The sums of each block of ``rays``, in the order of `blocks_of`. ``seen`` is shown each block before that, in
        the same order, where it is given."""
        names, inputs = self._files()
        common = described(names, self.options, OF_COUNTS, self.mode, inputs)
        common |= {"hits": counting.hits, "cohorts": counting.cohort_names}
        tasks = []
        if not isinstance(rays, Rays) and is_dataset(rays):
            data = RayDataset.open(rays).one_place()
            for (source, part), own in _groups(data):
                numbers = [p.number for _, p in own]
                paths = [data.folder / HEAD, source_path(data.folder, source.id)]
                found = read_inputs([*paths, *(data.folder / p.path(source.id) for _, p in own)])
                given = {"source": name_of(paths[1], found), "numbers": numbers}
                label = f"{source.file}, {part.day}, bucket {part.bucket}"
                tasks.append(self._task(count_part, {**common, **given}, (*inputs, *found), label))
            if seen is not None:
                for block in blocks_of(data, counting.rules):
                    seen(block)
        else:
            first = 1
            for block in blocks_of(rays, counting.rules):
                if seen is not None:
                    seen(block)
                label = f"rays {first:,} to {first + len(block) - 1:,}"
                tasks.append(self._task(count_part, common, (*inputs, self._held(block)), label))
                first += len(block)
        until = _DONE if seen is None else _COUNTED
        for made in self.parts.run(Plan(self.what, tasks), 0.0, until):
            yield from read_sums(made.path)

    def foretell(self, eyes: Eyes, view: float, changes: Path | None = None) -> Foretold:
        """What the field says of ``eyes`` that see ``view`` degrees, after the ``changes`` of a file, if there are
        any."""
        names, inputs = self._files()
        what, since, until = f"{self.what} (the field)", _COUNTED, _DONE
        if changes is not None:
            found = read_inputs(files_of_changes(changes, read_changes(changes)), below="changes")
            names, inputs = {**names, "changes": name_of(changes, found)}, (*inputs, *found)
            what, since, until = f"{self.what} (after the changes)", _TOLD, _CHANGED
        common = {**described(names, self.options, OF_FIELDS, self.mode, inputs), "view": view}
        tasks = []
        for a in range(0, len(eyes.positions), EYES):
            at, ahead = eyes.positions[a : a + EYES].tolist(), eyes.ahead[a : a + EYES].tolist()
            label = f"places {a + 1} to {a + len(at)}"
            tasks.append(self._task(foretell_part, {**common, "positions": at, "ahead": ahead}, inputs, label))
        found = [read_foretold(made.path) for made in self.parts.run(Plan(what, tasks), since, until)]
        each = {name: np.concatenate([getattr(f, name) for f in found]) for name in OF_EYES}
        return Foretold(**each, members=np.concatenate([f.members for f in found], axis=1))

    def _task(self, function: Callable, parameters: dict, inputs: tuple[InputFile, ...], label: str) -> Task:
        name = f"{function.__module__}:{function.__name__}"
        return Task(name, parameters, inputs, ".npz", versions(*RENDERS, "scipy"), label)

    def _held(self, block: Rays) -> InputFile:
        """A block in the store, with nothing in it of whom and of what it does not hold."""
        used = np.unique(block.person)
        own = replace(
            block,
            person=np.searchsorted(used, block.person).astype(np.int32),
            persons=tuple(block.persons[k] for k in used.tolist()),
            metadata={"frame": block.metadata["frame"]},
        )
        return self.parts.hold_rays(RAYS, own)

    def _files(self) -> tuple[dict[str, str], tuple[InputFile, ...]]:
        """What the files of the setting are called by tasks, and all inputs that it has."""
        o, checksums = self.options, Checksums()
        groups: dict[str, list[Path]] = {}
        if self.scene is not None:
            groups["scene"] = files_of_scene(self.scene)
        if self.gaze is not None:
            groups["gaze"] = [self.gaze, *([] if self.scene is not None else _place_beside(self.gaze, self.field))]
        if self.field is not None:
            groups["field"] = [self.field]
        assert o.areas is not None
        groups["areas"] = files_of_areas(o.areas, self.areas)
        groups |= {k: [Path(v)] for k, v in (("align", o.align), ("zones", o.zones), ("cohorts", o.cohorts)) if v}
        names, inputs = {}, []
        for kind, paths in groups.items():
            found = read_inputs(paths, checksums, below=kind)
            names[kind] = name_of(paths[0], found)
            inputs += found
        return names, tuple(inputs)


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
    if field is not None and place_key(gaze, about) == "field_file":
        return []
    path = file_of_training(gaze, about, None, "put it there", "put that one there")
    return files_of_scene(path) if path.suffix.lower() == ".xml" else [path]
