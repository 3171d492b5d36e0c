"""Parts of a count as tasks: what a worker runs for some of the rays, or of the places from which a field is asked."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.files.atomic import replacing
from nerg_mi.files.npy import read_npz
from nerg_mi.formats.areas.reading import read_areas
from nerg_mi.jobs.backend import select_backend
from nerg_mi.jobs.options.statistics import StatisticsOptions
from nerg_mi.rays.dataset.dataset import RayDataset
from nerg_mi.rays.dataset.layout import HEAD
from nerg_mi.rays.dataset.manifest import read_head, read_source
from nerg_mi.rays.rays import Rays
from nerg_mi.statistics.visits import Cell, LookRules, Sums
from nerg_mi.tasks.inputs import InputFile
from nerg_mi.tasks.task import canonical
from nerg_mi.threads import use_share

from .changes import read_changes
from .foretold import Foretold
from .setting import Setting, setting_of
from .tracked import Counting, Eyes, blocks_of, count_block

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
