"""Settings of a study as tasks: a few each, with the default beside them, measured wherever that is.

Errors and evaluations are the same whoever finds them. Times are those of the process that measured the row; its own
times of the default, taken in the same rounds, are in the row as well, so that rows of different machines compare.
"""

from __future__ import annotations

import uuid
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from nerg_mi.evaluation import study
from nerg_mi.evaluation.study import Setting, settings
from nerg_mi.evaluation.study_subject import ExactSurfaces, FileSubject, Subject, open_subject
from nerg_mi.files.safe_read import read_json
from nerg_mi.files.tables import write_json
from nerg_mi.rendering.scene_file import files_of_scene
from nerg_mi.tasks.code import RENDERS, processor
from nerg_mi.tasks.code import versions as code_versions
from nerg_mi.tasks.inputs import name_of, read_inputs
from nerg_mi.tasks.plan import Plan
from nerg_mi.tasks.task import Task, canonical
from nerg_mi.threads import use_share

from .backend import select_backend
from .film_tasks import named_defaults, placed_scene
from .options.study import StudyOptions
from .parts import Parts
from .reporter import Reporter

ROWS = 4
"""Settings of a part, besides the default."""

_TWIN = "twin.xml"
_PROCESS = uuid.uuid4().hex
_kept: dict[str, Subject] = {}


def measured_in_parts(
    subject: Subject,
    scene: str | Path,
    out: Path,
    rows: Sequence[Setting],
    numbers: tuple[int, int],
    mode: str,
    options: StudyOptions,
    reporter: Reporter,
) -> tuple[list[dict], list[dict], list[dict]]:
    """What `study.measure` finds of ``rows`` (the default first) and `study.scaling`, in parts; and who timed what:
    of each process its ``processor``, ``threads``, ``rows`` and, of the default there, the least and most ``seconds``.

    Rows say in ``timed_by`` which process it was, counted from 1, and have ``default_seconds`` and
    ``default_cpu_seconds`` of that one. ``numbers``: timed renders of each setting, and samples of a pixel's truth.
    """
    place = {row.name: k for k, row in enumerate(settings(subject, options.quick))}
    chosen = [place[row.name] for row in rows[1:]]
    given: dict[str, Any] = {"mode": mode, "quick": options.quick, "repeats": numbers[0], "samples": numbers[1]}
    given |= {"kind": "file", "size": [options.width, options.height]}
    values, inputs = options.defaults or {}, ()
    if isinstance(subject, FileSubject):
        twin = Path(scene).parent / _TWIN
        inputs = read_inputs([*files_of_scene(scene, values), *(files_of_scene(twin) if twin.is_file() else ())])
        given |= {"scene": name_of(scene, inputs), "twin": name_of(twin, inputs) if twin.is_file() else None}
    else:
        given |= {"kind": "analytic", "scene": str(scene)}
    given["defaults"] = named_defaults(values, inputs)
    tasks = []
    for of_part in (*(chosen[k : k + ROWS] for k in range(0, len(chosen), ROWS)), None):
        label = "cost against size" if of_part is None else f"{len(of_part)} settings from number {of_part[0]}"
        part = given | {"settings": of_part}
        tasks.append(Task(f"{__name__}:measure_part", part, inputs, ".json", code_versions(*RENDERS), label))
    plan = Plan(f"nerg study {out.absolute()}", tasks)
    return _joined([read_json(made.path, "part of a study") for made in Parts(options, out, reporter).run(plan)])


def measure_part(parameters: Mapping[str, Any], inputs: Mapping[str, Path], output: Path) -> None:
    """The rows (JSON) of some settings, the default first, and who timed them. ``parameters``: ``settings``, numbers
    of those of the ``scene``, None for its cost against size; ``kind``, ``size``, ``defaults``, ``twin``, ``quick``,
    ``repeats``, ``samples`` and ``mode``."""
    import drjit as dr

    select_backend(parameters["mode"])
    use_share()
    subject, quick, repeats = _subject(parameters, inputs), parameters["quick"], parameters["repeats"]
    if parameters["settings"] is None:
        rows = study.scaling(subject, min(repeats, 3), quick)
    else:
        every = settings(subject, quick)
        rows = study.measure(subject, [every[k] for k in (0, *parameters["settings"])], repeats, parameters["samples"])
    timed_by = {"process": _PROCESS, "processor": processor(), "threads": dr.thread_count()}
    write_json(output, {"rows": rows, "timed_by": timed_by}, allow_nan=True)


def _subject(parameters: Mapping[str, Any], inputs: Mapping[str, Path]) -> Subject:
    """What is studied, which stays for the next part: its truth may take longer than its settings."""
    own = ("settings", "repeats", "samples")
    where = sorted((str(path), path.stat().st_mtime_ns) for path in inputs.values())
    key = canonical([{k: v for k, v in parameters.items() if k not in own}, where])
    if key not in _kept:
        _kept.clear()
        scene, defaults, twin = parameters["scene"], {}, None
        if parameters["kind"] == "file":
            scene, defaults = placed_scene(parameters, inputs)
            twin = parameters["twin"] and inputs[parameters["twin"]]
        width, height = parameters["size"]
        _kept[key] = open_subject(str(scene), parameters["kind"], width, height, defaults, partial(_surfaces, twin))
    return _kept[key]


def _surfaces(twin: Path | None, scene: Path) -> ExactSurfaces | None:
    return None if twin is None else surfaces_of_twin(twin)


def twin_beside(scene: Path) -> ExactSurfaces | None:
    """The surfaces of the ``twin.xml`` beside a scene file; None where there is none."""
    file = scene.parent / _TWIN
    return surfaces_of_twin(file) if file.is_file() else None


def surfaces_of_twin(file: Path) -> ExactSurfaces:
    """The surfaces of the shapes in a scene file, which a field stands for."""
    from nerg_mi.scenes.store import twin  # pyright: ignore[reportMissingImports] at the root of a checkout

    shapes = twin.load_twin(file)
    return ExactSurfaces(partial(twin.cast, scene=shapes), partial(twin.visible, scene=shapes))


def _joined(parts: Iterable[Any]) -> tuple[list[dict], list[dict], list[dict]]:
    """The rows of all parts with a single default, the cost against size, and who timed them."""
    *of_settings, scaling = parts
    table: list[dict] = []
    who: dict[str, dict] = {}
    for part in of_settings:
        by, (default, *rest) = part["timed_by"], part["rows"]
        of_process = who.setdefault(by["process"], {**by, "process": len(who) + 1, "rows": 0, "seconds": []})
        of_process["seconds"].append(default["seconds"])
        for row in rest if table else (default, *rest):
            own = {f"default_{clock}": default[clock] for clock in ("seconds", "cpu_seconds")}
            table.append(row | own | {"timed_by": of_process["process"]})
            of_process["rows"] += 1
    for found in who.values():
        found["seconds"] = [min(found["seconds"]), max(found["seconds"])]
    return table, scaling["rows"], list(who.values())
