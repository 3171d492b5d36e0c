"""Trainings of an ablation as tasks: one for each variant and seed, wherever it is run."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from nerg_mi.evaluation import ablation
from nerg_mi.evaluation.ablation import Variant
from nerg_mi.files.atomic import replacing
from nerg_mi.files.safe_read import read_json
from nerg_mi.files.tables import write_json
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.scene_file import files_of_scene
from nerg_mi.tasks.code import RENDERS, versions
from nerg_mi.tasks.inputs import name_of, read_inputs
from nerg_mi.tasks.plan import Plan
from nerg_mi.tasks.task import FOLDER, Task
from nerg_mi.threads import use_share

from .ablation_bench import Bench, bench_of, train_variant
from .backend import select_backend
from .options import other_fields
from .options.ablation import AblationOptions
from .parts import Parts
from .reporter import SILENT, Reporter

_FIELD, _ROW = "gaze.safetensors", "row.json"
_RAYS = "of-the-job/rays.npz"
# But for files, which are inputs, what is ablated, and how it is timed and shared out.
_OF_TRAINING = other_fields(
    AblationOptions,
    *("field", "scene", "recipes", "variant", "seeds", "cameras", "size", "threads", "store", "scheduler"),
)

_last: dict[str, tuple[Bench, TemporaryDirectory]] = {}


def rows_in_parts(
    due: Sequence[tuple[Variant, int]], bench: Bench, rays: Rays, reporter: Reporter
) -> Iterator[dict[str, Any]]:
    """The row of each variant and seed that is ``due``, of which some may have been kept; its checkpoint is copied into
    the folder of ``bench``. ``rays``: all of them."""
    o, folder = bench.options, bench.folder
    parts = Parts(o, folder, reporter, o.threads)
    inputs, files = [parts.hold_rays(_RAYS, rays)], {}
    for kind, path in (("field", o.field), ("scene", o.scene)):
        if path is not None:
            found = read_inputs(files_of_scene(path) if kind == "scene" else [path], below=kind)
            inputs += found
            files[kind] = name_of(path, found)
    common = {"files": files, "options": {name: getattr(o, name) for name in _OF_TRAINING}}
    tasks = []
    for variant, seed in due:
        given = common | {"recipe": variant.recipe, "variant": variant.name, "seed": seed}
        label = f"{variant.recipe} {variant.name}, seed {seed}"
        tasks.append(Task(f"{__name__}:train_part", given, tuple(inputs), FOLDER, versions(*RENDERS, "scipy"), label))
    plan = Plan(f"nerg ablate {os.path.abspath(folder)}", tasks)
    for (variant, seed), made in zip(due, parts.run(plan)):
        with replacing(folder / variant.file_name(seed)) as temporary:
            shutil.copyfile(made.path / _FIELD, temporary)
        found = read_json(made.path / _ROW, "row of an ablation")
        assert isinstance(found, dict)
        yield found


def train_part(parameters: Mapping[str, Any], inputs: Mapping[str, Path], output: Path) -> None:
    """The checkpoint and the row (JSON) of one training, into the folder ``output``. ``parameters``: ``recipe``,
    ``variant`` and ``seed``, ``options`` and, by what they are called among ``inputs``, ``files``."""
    place = {kind: inputs[name] for kind, name in parameters["files"].items()}
    options = AblationOptions(**parameters["options"], field=place.get("field"), scene=place.get("scene"))
    ns = select_backend(options.mode)
    use_share()
    # What all variants have in common stays for the next one; another job has another.
    key = repr((parameters["options"], sorted((str(path), path.stat().st_mtime_ns) for path in inputs.values())))
    if key not in _last:
        _last.clear()
        folder = TemporaryDirectory(prefix="nerg-ablation-")
        _last[key] = bench_of(Rays.load(inputs[_RAYS]), options, Path(folder.name), ns, SILENT), folder
    bench = _last[key][0]
    known = ablation.all_variants(options.field is not None, [parameters["recipe"]])
    variant = next(v for v in known if v.name == parameters["variant"])
    write_json(output / _ROW, train_variant(variant, parameters["seed"], output / _FIELD, bench), allow_nan=True)
