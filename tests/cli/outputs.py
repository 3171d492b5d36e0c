"""Every command that writes, on inputs so small that it takes a second: its command line, and the files that it
writes."""

from __future__ import annotations

import importlib.util
import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.aoi.output import has_parquet
from nerg_mi.files.images import write_exr
from nerg_mi.formats.ply import write_columns
from nerg_mi.tracking.rays import Rays
from tests.evaluation.test_gaze import crowd
from tests.figures.standins import write_standins
from tests.formats.splats.writers import random_splats, write_inria
from tests.formats.test_torch_ngp import save_nerg as save
from tests.formats.test_torch_ngp import small_gaze, small_state
from tests.pictures import SCENE
from tests.plugins import fields
from tests.surfaces.meshes import box
from tests.watched import write_scene
from tools.with_defaults import find_defaults

DEMO = "occlusion.png gaze.png gaze_sphere.png depth.png visibility.png color.png scene.exr report.html run.json"
DEMO += " heatmap.glb aoi.csv"
HAS_TORCH = importlib.util.find_spec("torch") is not None
OF_TORCH = ("import", "export torch-ngp")
"""Commands that need it."""
STUDY = "study.csv study.md scaling.csv study.json errors.png scaling.png"
BIDS = "README dataset_description.json participants.json participants.tsv task-gaze_physio.json "
BIDS += "task-gaze_physioevents.json "
BIDS += " ".join(
    f"sub-{p}/beh/sub-{p}_task-gaze_recording-eye1_physio{suffix}"
    for p in "abcd"
    for suffix in (".json", ".tsv.gz", "events.tsv.gz")
)
EVALUATION = "gaze.md gaze.csv persons.csv gaze.json positions.csv positions.png"
EVALUATED = (
    *(f"evaluation.gaze.{name}" for name in ("score_methods", "score_split_half", "score_participants")),
    "evaluation.held_out.make_tuned_baselines",
    "evaluation.held_out.correlate_uncertainty",
)
STATS = "aois.csv aois.md transitions.csv transitions.md durations.csv durations.md participants.csv participants.md "
STATS += "aois.png transitions.png "
STATS += "about.json"
if has_parquet():
    STATS += " aois.parquet transitions.parquet durations.parquet participants.parquet"
ROBUSTNESS = " ".join(
    f"{table}{suffix}"
    for table in ("conclusions", "analyses", "estimates")
    for suffix in (".csv", ".md", *([".parquet"] if has_parquet() else []))
)
GAZE = "--radius 0.6 --steps 2 --min-rays 8 --seed 1"


@dataclass(frozen=True)
class Case:
    """A command that writes files.

    ``line``: the command line, with the folders ``{i}`` of the inputs and ``{o}`` of the outputs. ``files``: all files
    that it writes to ``{o}``. ``blocked``: outputs that an existing file or folder can block, which is reported before
    any work. ``once``: functions that take seconds and write nothing. ``needs_new_folder``: whether the output is a
    folder that must not have any files. ``defaults``: values of parameters that are no options."""

    name: str
    line: str
    files: tuple[str, ...]
    blocked: tuple[str, ...] = ()
    once: tuple[str, ...] = ()
    needs_new_folder: bool = False
    defaults: Mapping[str, Any] = field(default_factory=dict)

    def set_defaults(self, monkeypatch: Any, inputs: Path) -> None:
        """Change the defaults of the function that the command calls."""
        values = dict(self.defaults)
        if self.name == "demo":
            values["defaults"] = json.loads((inputs / "demo.json").read_text())
        if not values:
            return
        defaults = find_defaults(self.name.split())
        assert values.keys() <= defaults.keys()
        for name, value in values.items():
            monkeypatch.setitem(defaults, name, value)

    def arguments(self, inputs: Path, out: Path) -> list[str]:
        """The command line for these folders."""
        return [word.format(i=inputs, o=out) for word in [*self.name.split(), *shlex.split(self.line)]]

    @property
    def targets(self) -> tuple[str, ...]:
        return self.blocked or self.files


def _below(folder: str, names: str) -> tuple[str, ...]:
    return tuple(f"{folder}/{name}" for name in names.split())


CASES = (
    Case(
        "demo",
        "-o {o}/demo --width 24 -m llvm_ad_rgb",
        _below("demo", DEMO),
        ("demo",),
        ("reports.report.ReportBuilder.build", "surfaces.bake.compute_sums"),
    ),
    Case("render", "{i}/scene.xml -o {o}/a.exr -m llvm_ad_rgb", ("a.exr",)),
    Case("render", "{i}/scene.xml -o {o}/a.png -m llvm_ad_rgb", ("a.png",)),
    Case("render", "{i}/scene.xml -o {o}/a.png -m llvm_ad_rgb --frames {i}/frames.csv", ("a_0001.png", "a_0002.png")),
    Case(
        "render",
        "{i}/ball.xml -o {o}/a.png -m llvm_ad_rgb --frames {i}/frames.csv --overlay depth",
        ("a_0001.png", "a_0002.png"),
    ),
    Case("render", "{i}/ball.xml -o {o}/a.svg -m llvm_ad_rgb --overlay depth", ("a.svg",)),
    Case("render", "{i}/ball.xml -o {o}/a.mp4 -m llvm_ad_rgb --frames {i}/frames.csv --overlay depth", ("a.mp4",)),
    Case(
        "render",
        "{i}/scene.xml -o {o}/a.png -m llvm_ad_rgb --frames {i}/frames.csv --store {i}/store",
        ("a_0001.png", "a_0002.png"),
    ),
    Case("draw floor", "{i}/rays.npz -o {o}/a.png", ("a.png",)),
    Case("draw floor", "{i}/rays.npz -o {o}/a.svg --scene {i}/ball.xml", ("a.svg",)),
    Case("draw scanpath", "{i}/still.npz {i}/ball.xml -o {o}/a.png", ("a.png",)),
    Case(
        "draw area",
        "{i}/rays.npz -o {o}/a.png --samples {o}/a.csv --image {o}/b.png --aois {i}/areas.json --area high",
        ("a.png", "a.csv", "b.png"),
    ),
    Case("draw sheet", "{i}/a.exr {i}/b.exr -o {o}/a.png --overlay gaze", ("a.png",)),
    Case("draw difference", "{i}/a.exr {i}/b.exr -o {o}/a.svg", ("a.svg",)),
    Case("draw surface", "{i}/baked.ply -o {o}/a.png --width 32 --height 32", ("a.png",)),
    Case("draw sphere", "{i}/watched/gaze.xml -o {o}/a.png --width 64", ("a.png",)),
    Case("draw triptych", "{i}/watched/gaze.xml -o {o}/a.png", ("a.png",)),
    Case("scene", "{i}/rays.npz -o {o}/a.xml -e none", ("a.xml",)),
    Case("scene", "{i}/rays.npz -o {o}/a.xml", ("a.xml", "a.vol", "a.color.vol")),
    Case("scene", "{i}/rays.npz -o {o}/a.xml -e none --person a --time-range 0,2", ("a.xml", "a.frames.csv")),
    Case(
        "report",
        "{i}/gaze.safetensors {i}/rays.npz -o {o}/a.html --width 24 -m llvm_ad_rgb",
        ("a.html",),
        once=("reports.report.ReportBuilder.build",),
    ),
    Case("rays import", "{i}/day.csv -o {o}/a.npz --map 'origin=x,y,z direction=a,b,c t=t person=p'", ("a.npz",)),
    Case(
        "rays import",
        "{i}/day.csv -o {o}/a.npz --map 'origin=x,y,z direction=a,b,c t=t person=p' --align-output {o}/align.json",
        ("a.npz", "align.json"),
    ),
    Case("rays filter", "{i}/rays.npz -o {o}/a.npz --person a", ("a.npz",)),
    Case("rays filter", "{i}/rays.npz -o {o}/a.parquet --person a", ("a.parquet",)),
    Case("rays events", "{i}/rays.npz -o {o}/a.csv --quality {o}/b.csv", ("a.csv", "b.csv")),
    Case("rays export", "{i}/rays.npz -o {o}/bids", _below("bids", BIDS), ("bids",), needs_new_folder=True),
    Case("rays split", "{i}/rays.npz -o {o}/a.npz --test-participants 0.5", ("a-train.npz", "a-test.npz")),
    Case("rays plot", "{i}/rays.npz -o {o}/a.png", ("a.png",)),
    Case(
        "stats",
        "{i}/rays.npz -o {o}/numbers --aois {i}/areas.json --resamples 199 -m llvm_ad_rgb --store {i}/store",
        _below("numbers", STATS),
        ("numbers",),
    ),
    Case(
        "robustness",
        "{i}/rays.npz -o {o}/numbers --aois {i}/areas.json --analyses 10 -m llvm_ad_rgb --store {i}/store",
        _below("numbers", ROBUSTNESS + " robustness.png about.json"),
        ("numbers",),
    ),
    Case("align", "-o {o}/a.json --pairs {i}/pairs.csv", ("a.json", "a.png")),
    Case("rays plot", "{i}/rays.npz -o {o}/a.png --kind layout", ("a.png",)),
    Case(
        "train radiance",
        "{i}/photos -o {o}/a.safetensors --steps 2 --holdout 2",
        ("a.safetensors", "a.preview.png", "a.curves.csv", "a.curves.png"),
        ("a.safetensors", "a.preview.png", "a.curves.csv", "a.curves.png", "a.run"),
        ("train.radiance_grid.MarchGrid.extract_occupancy", "train.radiance_run.warm_up"),
    ),
    Case(
        "train gaze",
        "{i}/rays.npz -o {o}/a.safetensors --environment hits " + GAZE,
        ("a.safetensors", "a.vol"),
        ("a.safetensors", "a.vol", "a.run"),
        ("train.gaze_folds.evaluate_folds", "train.gaze_run.evaluate_folds", "train.gaze_ensemble.evaluate_folds"),
        defaults={"prior_folds": 1},
    ),
    Case(
        "train gaze",
        "{i}/rays.npz -o {o}/a.safetensors --environment none --ensemble 2 " + GAZE,
        ("a.safetensors",),
        ("a.safetensors", "a.run"),
        ("train.gaze_folds.evaluate_folds", "train.gaze_run.evaluate_folds", "train.gaze_ensemble.evaluate_folds"),
        defaults={"prior_folds": 1},
    ),
    Case("train prior", "{i}/rays.npz {i}/rays.npz -o {o}/a.safetensors", ("a.safetensors",)),
    Case(
        "eval radiance",
        "{i}/field.safetensors {i}/photos --holdout 2 -o {o}/eval --json {o}/a.json",
        ("eval/0.png", "eval/2.png", "a.json"),
        ("eval", "a.json"),
    ),
    Case(
        "eval folds",
        "{i}/rays.npz -o {o}/folds --store {i}/store --environment none --folds 2 --test-zones 1 "
        "--radius 0.6 --steps 2 --min-rays 8 --splits pos --seed 1",
        _below("folds", "folds.md folds.csv positions.csv folds.json"),
        ("folds",),
        ("train.gaze_folds.evaluate_folds", "train.gaze_run.evaluate_folds", *EVALUATED),
        defaults={"test_positions": 3},
    ),
    Case(
        "eval gaze",
        "{i}/gaze.safetensors {i}/rays.npz -o {o}/eval --min-rays 8 --resamples 2",
        _below("eval", EVALUATION),
        ("eval",),
        EVALUATED,
    ),
    Case(
        "eval next",
        "{i}/participants.safetensors {i}/rays.npz -o {o}/next --elapsed 12 --resamples 2",
        _below("next", "next.md next.csv next.json"),
        ("next",),
        ("evaluation.next_look_scores.evaluate_on_grid",),
    ),
    Case(
        "bake",
        "{i}/room.ply --rays {i}/rays.npz --max-edge 2 -m llvm_ad_rgb -o {o}/a.ply -o {o}/a.csv -o {o}/a.json",
        ("a.ply", "a.csv", "a.json"),
    ),
    Case(
        "bake",
        "{i}/room.ply --rays {i}/rays.npz --max-edge 2 -m llvm_ad_rgb --store {i}/store -o {o}/a.glb",
        ("a.glb",),
    ),
    Case(
        "bake", "{i}/splats.ply --gaze {i}/gaze.safetensors --observer 0,0,-3 -m llvm_ad_rgb -o {o}/a.ply", ("a.ply",)
    ),
    Case("import", "{i}/nerg.pth -o {o}/a.safetensors -g {o}/g.safetensors", ("a.safetensors", "g.safetensors")),
    Case("refine", "{i}/full.safetensors -o {o}/a.safetensors", ("a.safetensors",)),
    Case("compile", "{i}/full.safetensors -o {o}/a.safetensors --resolution 16", ("a.safetensors",)),
    Case("export mesh", "{i}/field.safetensors -o {o}/a.ply --resolution 8 --density-threshold 3", ("a.ply",)),
    Case("export mesh", "{i}/field.safetensors -o {o}/a.glb --resolution 8 --density-threshold 3", ("a.glb",)),
    Case("export points", "{i}/field.safetensors -o {o}/a.ply --resolution 8", ("a.ply",)),
    Case("export splats", "{i}/field.safetensors -o {o}/a.ply --resolution 8", ("a.ply",)),
    Case("export volume", "{i}/field.safetensors -o {o}/a.vol --color {o}/c.vol --resolution 8", ("a.vol", "c.vol")),
    Case("export scene", "{i}/room.ply {i}/rays.npz -o {o}/a.usdc", ("a.usdc",)),
    Case("export scene", "{i}/room.ply {i}/rays.npz -o {o}/a.rrd", ("a.rrd",)),
    Case("export torch-ngp", "{i}/ngp.safetensors -o {o}/a.pth", ("a.pth",)),
    Case(
        "study",
        "slab -o {o}/study --store {i}/store --quick --width 12 --height 8 --only jitter -m llvm_ad_rgb",
        _below("study", STUDY),
        ("study",),
        ("evaluation.study.measure_rows", "evaluation.study.measure_scaling"),
    ),
)

MAKES_A_FOLDER = {"poses"}
"""Commands that make a folder as a whole, which must not be there before: `test_scenes` tries them."""

INPUTS = {
    "scene": {"environment", "photos", "align"},
    "view": {"areas", "align"},
    "render": {"frames", "objects", "align"},
    "stats": {"aois", "align", "zones", "cohorts", "validation", "objects", "what_if", "salt"},
    "robustness": {"aois", "align", "zones", "cohorts", "validation"},
    "draw area": {"aois", "align", "objects"},
    "draw floor": {"scene"},
    "align": {"environment", "surface", "pairs", "tracking_surface", "tracking_cameras", "scene_cameras", "init"},
    "rays events": {"targets"},
    "rays export": {"aois", "scene", "align"},
    "rays import": {"pseudonyms", "poses", "place"},
    "rays plot": {"test"},
    "train gaze": {"views", "salience", "align_views", "environment", "align"},
    "eval folds": {"environment", "align"},
    "eval gaze": {"environment"},
    "eval next": {"environment"},
    "report": {"aois"},
    "bake": {"gaze", "rays", "observer_file", "align"},
}
"""Options of commands that name what is read, as arguments do; all others that are paths are written."""


def make_inputs(folder: Path) -> Path:
    """Write the inputs of `CASES` to ``folder``."""
    import drjit.llvm.ad as ns
    import mitsuba as mi

    from nerg_mi.fields.encoding import HashGridConfig
    from nerg_mi.fields.occupancy import OccupancyGrid
    from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork
    from nerg_mi.formats.fields import save_radiance
    from nerg_mi.maths.geometry import Box

    (folder / "scene.xml").write_text(SCENE)
    (folder / "ball.xml").write_text(SCENE.replace('type="aov"><string name="aovs" value="dd:depth"/>', 'type="nerg">'))
    (folder / "frames.csv").write_text("level\n0.25\n0.5\n")
    (folder / "demo").mkdir()
    (folder / "demo.json").write_text(json.dumps(write_standins(folder / "demo")))
    rows = [f"{t},a,{0.1 * t},0,1.6,0,1,0" for t in range(2000)]
    (folder / "day.csv").write_text("\n".join(["t,p,x,y,z,a,b,c", *rows]))
    areas = {"low": [[1.4, -2, 0], [1.6, 2, 1.2]], "high": [[1.4, -2, 1.2], [1.6, 2, 3]]}
    (folder / "areas.json").write_text(json.dumps(areas))
    pairs = "x,y,z,place_x,place_y,place_z\n0,0,0,1,0,0\n1,0,0,2,0,0\n0,1,0,1,1,0\n0,0,1,1,0,1\n"
    (folder / "pairs.csv").write_text(pairs)
    write_scene(folder / "watched", "gaze.xml")
    for k, name in enumerate("ab"):
        write_exr(folder / f"{name}.exr", {"gaze.Y": np.full((12, 16), 1.0 + k, np.float32)})
    rays: Rays = crowd(3000)
    rays.save(folder / "rays.npz")
    ahead = np.tile([1.0, 0, 0], (30, 1))
    Rays(np.arange(30) / 30, np.zeros(30), ("a",), 0 * ahead, ahead, np.ones(30)).save(folder / "still.npz")
    vertices, faces = box((-9, -9, -1), (9, 9, 4))
    write_columns(folder / "room.ply", dict(zip("xyz", vertices.T)), faces)
    columns = dict(zip("xyz", vertices.T)) | {"value": np.arange(len(vertices), dtype=np.float32)}
    write_columns(folder / "baked.ply", columns, faces)
    fields.radiance(folder / "field.safetensors")
    full = OccupancyGrid(np.ones((4, 4, 4), bool), ns, 0.1)
    fields.radiance(folder / "full.safetensors", density_scale=1e-2, occupancy=full)
    write_inria(folder / "splats.ply", random_splats(9))
    if HAS_TORCH:
        save(folder / "nerg.pth", small_gaze(), nerf=small_state())
    # These are the sizes of torch-ngp.
    cells = OccupancyGrid(np.random.default_rng(1).random((128, 128, 128)) < 0.3, ns, 0.01)
    ngp = RadianceNetwork.random(RadianceConfig(HashGridConfig()), Box((-1, -1, -1), (1, 1, 1)), ns, occupancy=cells)
    save_radiance(ngp, folder / "ngp.safetensors", {}, half=True)

    photos, frames = folder / "photos", []
    photos.mkdir()
    for k in range(4):
        mi.Bitmap(np.full((14, 16, 3), 128, np.uint8)).write(str(photos / f"{k}.png"))
        pose = np.eye(4)
        pose[:3, 3] = 0.05 * k, 0, 3
        frames.append({"file_path": f"{k}.png", "transform_matrix": pose.tolist()})
    lens = {"w": 16, "h": 14, "fl_x": 60.0, "fl_y": 60.0, "cx": 8.0, "cy": 7.0}
    metadata = {**lens, "frames": frames, "aabb": [[-1, -1, -1], [1, 1, 1]]}
    (photos / "transforms.json").write_text(json.dumps(metadata))
    return folder


def list_trainings(folder: Path) -> list[list[str]]:
    """Command lines that train the gaze fields of `CASES` on the inputs in ``folder``, without and with held-out
    participants."""
    line = f"train gaze {folder}/rays.npz --environment hits --radius 0.5 --steps 2"
    line += " --min-rays 8 --test-zones 1 --test-positions 3"
    more = f"-o {folder}/gaze.safetensors", f"--test-participants 0.5 -o {folder}/participants.safetensors"
    return [[*line.split(), *words.split()] for words in more]
