"""A count in parts: rays and places shared out, the task of each part, and sums taken in one order."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.files.atomic import replacing
from nerg_mi.files.safe_read import read_npz
from nerg_mi.formats.areas.kinds import Areas
from nerg_mi.formats.areas.reading import files_of_areas, read_areas
from nerg_mi.formats.checkpoint import read_metadata
from nerg_mi.jobs.backend import select_backend
from nerg_mi.jobs.gaze_places import file_of_training, place_key
from nerg_mi.jobs.parts import Parts
from nerg_mi.rays.dataset import HEAD, RayDataset, is_dataset, read_head, read_source, source_path
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.scene_file import files_of_scene
from nerg_mi.statistics.visits import Cell, LookRules, Sums
from nerg_mi.tasks.code import RENDERS, versions
from nerg_mi.tasks.inputs import Checksums, InputFile, name_of, read_inputs
from nerg_mi.tasks.plan import Plan
from nerg_mi.tasks.task import Task, canonical
from nerg_mi.threads import use_share

from .measured import Counting, Eyes, blocks_of, count_block
from .options import StatisticsOptions
from .predicted import Foretold, Setting, setting_of
from .scene import files_of_changes, read_changes

# ---- Tasks ----
#
# Parts of a count as tasks: what a worker runs for some of the rays, or of the places from which a field is asked.


OF_COUNTS = ("tolerance", "margin", "gap", "pause", "merge", "least", "seen", "view", "cell", "samples", "windows")
"""The options on which sums of rays depend, besides files."""

OF_FIELDS = ("margin", "samples", "directions")
"""Those on which depends what a field foretells."""

OF_EYES = ("share", "distance", "visible", "support")
"""What is foretold of each eye, a row each; by the members of an ensemble apart it has an axis before that."""

RAYS = "of-the-job/rays.npz"
"""What a task calls rays that a job holds."""

_kept: dict[str, Any] = {}


def count_part(parameters: Mapping[str, Any], inputs: Mapping[str, Path], output: Path) -> dict[str, int]:
    """The sums (.npz) of each block of the rays `RAYS`, or of those parts of a dataset that are among ``inputs``, with
    the number of blocks as a note. ``parameters``: see `described`, and ``hits`` and ``cohorts`` of
    `Setting.counting`, ``source`` and ``numbers`` of the parts of a dataset."""

    def make() -> Counting:
        return _setting(parameters, inputs).counting(parameters["hits"], tuple(parameters["cohorts"]))

    counting = _prepared(parameters, make)
    found = [count_block(block, counting) for block in _blocks(parameters, inputs, counting.rules)]
    write_sums(output, found)
    return {"blocks": len(found)}


def foretell_part(parameters: Mapping[str, Any], inputs: Mapping[str, Path], output: Path) -> None:
    """What a field foretells (.npz) of people at ``positions`` who look ``ahead`` and see ``view`` degrees;
    ``parameters``: these, and see `described`."""
    setting = _prepared(parameters, lambda: _setting(parameters, inputs))
    at, ahead = np.array(parameters["positions"]), np.array(parameters["ahead"])
    found = setting.foretold(Eyes(at, ahead, ("",) * len(at), (frozenset(),) * len(at)), parameters["view"])
    with replacing(output) as temporary, temporary.open("wb") as out:
        np.savez(out, **{name: getattr(found, name) for name in (*OF_EYES, "members")})


def described(
    names: Mapping[str, str],
    options: StatisticsOptions,
    which: tuple[str, ...],
    mode: str,
    inputs: tuple[InputFile, ...],
) -> dict[str, Any]:
    """Parameters of tasks that count in one setting: what its files are called among ``inputs``, by ``names`` such as
    scene or areas, those of the ``options`` on which they depend, and a ``digest`` of it."""
    found = {"files": dict(names), "options": {name: getattr(options, name) for name in which}, "mode": mode}
    files = {file.name: file.sha256 for file in inputs}
    return found | {"digest": hashlib.sha256(canonical([found, files]).encode()).hexdigest()}


def write_sums(path: Path, found: list[Sums]) -> None:
    """Write sums one by one (.npz), so that whoever adds them does so in the order in which they were made."""
    arrays: dict[str, np.ndarray] = {}
    for k, sums in enumerate(found):
        cells = [asdict(cell) for cell in sums.cells]
        place = {cell: c for c, cell in enumerate(sums.cells)}
        rows = [(place[cell], person) for cell, person in sums.rows]
        arrays[f"{k}.names"] = np.array(json.dumps({"areas": sums.areas, "cells": cells, "rows": rows}))
        arrays |= {f"{k}.{name}": getattr(sums, name) for name in _ARRAYS}
    with replacing(path) as temporary, temporary.open("wb") as out:
        np.savez(out, allow_pickle=False, **arrays)


def read_sums(path: Path) -> list[Sums]:
    """What `write_sums` has written."""
    arrays = read_npz(path, "part of a count")
    found = []
    for k in range(len(arrays) // (len(_ARRAYS) + 1)):
        names = json.loads(str(arrays[f"{k}.names"]))
        cells = tuple(Cell(**cell) for cell in names["cells"])
        rows = tuple((cells[c], person) for c, person in names["rows"])
        found.append(Sums(tuple(names["areas"]), cells, rows, **{name: arrays[f"{k}.{name}"] for name in _ARRAYS}))
    return found


def read_foretold(path: Path) -> Foretold:
    """What `foretell_part` has written."""
    return Foretold(**read_npz(path, "part of what a field foretells"))


_ARRAYS = tuple(f.name for f in fields(Sums) if f.name not in ("areas", "cells", "rows"))


def _blocks(parameters: Mapping[str, Any], inputs: Mapping[str, Path], rules: LookRules) -> Iterator[Rays]:
    if RAYS in inputs:
        # A block as a whole: it was cut already.
        yield Rays.load(inputs[RAYS])
        return
    folder = inputs[HEAD].parent
    head = read_head(folder)
    source = read_source(inputs[parameters["source"]], head)
    parts = tuple((source, part) for part in source.parts if part.number in parameters["numbers"])
    yield from blocks_of(RayDataset(folder, head, (source,), parts), rules)


def _setting(parameters: Mapping[str, Any], inputs: Mapping[str, Path]) -> Setting:
    """The setting of the files and options of ``parameters``, in its Mitsuba variant, after changes if it has any."""
    files = {kind: inputs[name] for kind, name in parameters["files"].items()}
    areas = files["areas"]
    areas = areas.parent if areas.suffix == ".csv" else areas
    given = parameters["options"] | {kind: files.get(kind) for kind in ("align", "zones", "cohorts")}
    given |= {"windows": tuple(given["windows"])} if "windows" in given else {}
    options = StatisticsOptions(**given, areas=areas)
    ns = select_backend(parameters["mode"])
    made = setting_of(files.get("scene"), files.get("field"), files.get("gaze"), read_areas(areas), options, ns)
    return made.changed(read_changes(files["changes"])) if "changes" in files else made


def _prepared(parameters: Mapping[str, Any], make: Callable[[], Any]) -> Any:
    """What is made once for all tasks of one setting; the last one is kept."""
    use_share()
    if parameters["digest"] not in _kept:
        _kept.clear()
        _kept[parameters["digest"]] = make()
    return _kept[parameters["digest"]]


# ---- Parts ----
#
# A count in parts, wherever they are made: rays and places shared out, sums taken in one order.


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
