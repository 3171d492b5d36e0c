"""Commands that train, score and convert fields: arguments of their workflows, output files and messages."""

from __future__ import annotations

import json
import re
from pathlib import Path

import drjit.llvm.ad as ns
import numpy as np
import pytest
import trimesh

from nerg_mi.errors import NergError
from nerg_mi.fields.occupancy import OccupancyGrid
from nerg_mi.files.atomic import file_sha256
from nerg_mi.formats.checkpoint import read_checkpoint, read_metadata
from nerg_mi.formats.fields import load_gaze, load_radiance, matches_checksum
from nerg_mi.formats.torch_files import write_torch
from nerg_mi.train.compile import compile_field
from tests.evaluation.test_gaze import crowd
from tests.formats.test_torch_ngp import save_nerg as save
from tests.formats.test_torch_ngp import small_gaze, small_state
from tests.plugins.fields import radiance
from tests.recorder import Recorder
from tests.refusals import mentions

# ---- Radiance fields ----


def test_training_and_evaluation_write_scores_and_files(cube, nerg):
    ended = nerg("eval", "radiance", cube / "cube.safetensors", cube, "--holdout", 2, "--json", cube / "s.json")
    assert not ended.code
    scores = json.loads((cube / "s.json").read_text())
    assert scores["width"] == 16 and scores["height"] == 14 and scores["views"]
    assert scores["psnr_mean"] == pytest.approx(-20 * np.log10(128 / 255 - 0.5), abs=1.5)
    assert len(scores["psnr"]) == len(scores["views"]) == len(list((cube / "cube.eval").iterdir()))


@pytest.mark.nightly
def test_speed_and_complaints_are_reported(cube, nerg):
    ended = nerg("train", "radiance", cube, "-o", cube / "a.safetensors", "--steps", 3, "--holdout", 3)
    assert not ended.code and "warning: only 3 steps" in ended.err
    assert float(re.search(r"3 steps in \d+ s; (\S+) field evaluations per second", ended.out)[1]) > 0
    provenance = read_checkpoint(cube / "a.safetensors", "radiance")[1]["provenance"]
    assert provenance["evaluations_a_second"] > 0 and provenance["step_ms"]["max"] >= provenance["step_ms"]["median"]
    assert [x for x in provenance["complaints"] if x.startswith("only 3 steps")]


# The command, and its message if the photos can be read.
OUTSIDE = {
    "train radiance": ("train radiance {c}/set -o {c}/out.safetensors --steps 2 --holdout 3", r"2 steps in"),
    "eval radiance": ("eval radiance {c}/cube.safetensors {c}/set --holdout 2 -o {c}/out.safetensors", r"PSNR"),
}


@pytest.mark.parametrize("name", OUTSIDE)
def test_photos_beyond_the_folder_are_read_only_if_allowed(name, cube, nerg):
    (cube / "set").mkdir()
    text = (cube / "transforms.json").read_text()
    (cube / "set" / "transforms.json").write_text(re.sub(r'"(\d.png)"', r'"../\1"', text))
    line, said = OUTSIDE[name]
    line = line.format(c=cube).split()
    ended = nerg(*line)
    assert ended.code == 1 and "--allow-outside" in ended.err and not re.search(said, ended.out + ended.err)
    ended = nerg(*line, "--allow-outside")
    assert re.search(said, ended.out + ended.err) and "outside of" not in ended.out + ended.err


# ---- Gaze fields ----

PATHS = {"field": "place.safetensors", "scene": "room.xml", "views": "photos", "align_views": "a.json"} | {
    "align": "b.json"
}


def other_value(f):
    """A value of the option ``f`` that differs from its default."""
    if f.name in PATHS:
        return Path(PATHS[f.name])
    if f.name == "mode":
        return "llvm_ad_mono"
    hint = str(f.type)
    if "bool" in hint:
        return not f.default if isinstance(f.default, bool) else False
    if "str" in hint:
        return "hits" if f.name == "geometry" else "word"
    within = f.metadata["nerg_mi.range"]
    value = within.low + (0.25 if "float" in hint else 1)
    return value if value != f.default else value + 1


@pytest.mark.parametrize("recipe", ["default", "small"])
def test_a_field_is_trained_from_salience_images(recipe, tmp_path, nerg, rgb):
    """Six photos from positions a metre apart; five of them have saliency maps."""
    frames, rng = [], np.random.default_rng(0)
    (tmp_path / "maps").mkdir()
    for k in range(6):
        pose = np.eye(4)
        pose[:3, 3] = k, 0, 1.6
        rgb.Bitmap(rng.integers(0, 255, (12, 16, 3)).astype(np.uint8)).write(str(tmp_path / f"p{k}.png"))
        if k:
            np.save(tmp_path / "maps" / f"p{k}.npy", rng.uniform(size=(12, 16)))
        frames.append({"file_path": f"p{k}.png", "transform_matrix": pose.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 1.0, "frames": frames}))
    # The recipe small needs a geometry: a scene of one wall.
    scene, out = tmp_path / "wall.xml", tmp_path / "out.safetensors"
    scene.write_text('<scene version="3.0.0"><shape type="cube"/></scene>')
    place = ["--environment", "none" if recipe == "default" else scene]
    quick = "--steps 2".split()
    images = ["--views", tmp_path, "--salience", tmp_path / "maps"]
    ended = nerg("train", "gaze", *images, "--recipe", recipe, *place, *quick, "-o", out)
    assert ended.code == 0, ended.err
    assert (
        "5 views with saliency maps; without saliency map: p0.png" in ended.out and "0 probes and 5 views" in ended.out
    )
    field, meta = load_gaze(out, ns)
    assert field.config.normalized and meta["provenance"]["salience"]["used"] == 5
    assert "rays_file" not in meta["provenance"]


@pytest.mark.nightly
def test_a_field_is_scored_as_it_was_trained(tmp_path, nerg):
    crowd().save(tmp_path / "rays.npz")
    gaze = tmp_path / "gaze.safetensors"
    line = "--environment hits --radius 0.6 --steps 5"
    train = ["train", "gaze", tmp_path / "rays.npz", "-o", gaze, *line.split()]
    assert nerg(*train).code == 0
    ended = nerg("eval", "gaze", gaze, tmp_path / "rays.npz")
    assert ended.code == 1 and "--test-zones 3" in ended.err
    assert nerg(*train, "--test-zones", "2", "--test-positions", "6", "--test-participants", "0.5").code == 0
    line = "--min-rays 16 --resamples 4"
    assert nerg("eval", "gaze", gaze, tmp_path / "rays.npz", *line.split()).code == 0
    scores = json.loads((tmp_path / "gaze.eval" / "gaze.json").read_text())
    names = [r["method"] for r in scores["methods"]]
    assert names[:2] == ["gaze field", "uniform"] and "nearest rays" in names and scores["split"] == "both"
    assert scores["methods"][0]["integral"] == pytest.approx(1, abs=0.02)
    for name in ("gaze.md", "gaze.csv", "persons.csv", "positions.png"):
        assert (tmp_path / "gaze.eval" / name).stat().st_size > 100
    crowd(seed=1).save(tmp_path / "others.npz")
    ended = nerg("eval", "gaze", gaze, tmp_path / "others.npz")
    assert ended.code == 1 and "was not trained on" in " ".join(ended.err.split())


# ---- Import and export ----


def test_a_nerf_is_imported(tmp_path, nerg, torch):
    write_torch(tmp_path / "ngp.pth", {"model": small_state()})
    ended = nerg("import", tmp_path / "ngp.pth", "-o", tmp_path / "field.safetensors", "--color-space", "linear")
    assert ended.code == 0 and "raw weights, no occupancy grid" in ended.out and "wrote" in ended.out
    field, meta = load_radiance(tmp_path / "field.safetensors", ns)
    assert field.color_space == "linear" and meta["provenance"]["format"] == "torch-ngp"
    assert np.array_equal(field.color_net.weights[2].numpy(), small_state()["color_net.2.weight"])


def test_a_nerf_and_its_gaze_are_imported(tmp_path, nerg, torch):
    path = save(tmp_path / "nerg.pth", small_gaze(), nerf=small_state())
    ended = nerg("import", path, "-o", tmp_path / "field.safetensors")
    assert ended.code == 0 and "--gaze" in ended.out
    ended = nerg("import", path, "-o", tmp_path / "f.safetensors", "-g", tmp_path / "g.safetensors")
    assert ended.code == 0 and "gaze: emit_capture, trunk layernorm, bound 1" in ended.out
    assert (tmp_path / "g.safetensors").is_file()


def test_a_field_is_exported_in_each_format(tmp_path, nerg):
    radiance(tmp_path / "f.safetensors")

    def export(kind, name, *arguments):
        ended = nerg("export", kind, tmp_path / "f.safetensors", "-o", tmp_path / name, *arguments)
        assert ended.code == 0, ended.err
        return ended.out

    said = export("points", "p.ply", "--resolution", 8)
    assert f"{len(trimesh.load(tmp_path / 'p.ply').vertices):,} points" in said
    said = export("volume", "d.vol", "--color", tmp_path / "c.vol", "--resolution", 8)
    assert "8 x 8 x 8 voxels from (-1, -1, -1) to (1, 1, 1)" in said
    assert (tmp_path / "c.vol").stat().st_size == 48 + 8**3 * 3 * 4 == 3 * (tmp_path / "d.vol").stat().st_size - 2 * 48
    pytest.importorskip("skimage")
    assert "around holes" in export("mesh", "m.glb", "--resolution", 16, "--density-threshold", 3)
    assert len(trimesh.load(tmp_path / "m.glb", force="mesh").faces) > 100


def test_a_compiled_field_states_its_errors(tmp_path, nerg):
    radiance(tmp_path / "f.safetensors", density_scale=5.0)
    ended = nerg("compile", tmp_path / "f.safetensors", "-o", tmp_path / "g.safetensors", "--resolution", "64")
    assert ended.code == 0 and "64 cells" in ended.out and " dB" in ended.out
    meta = read_metadata(tmp_path / "g.safetensors")
    assert meta["provenance"]["compiled"]["resolution"] == meta["voxels"]["resolution"] == 64
    assert matches_checksum(tmp_path / "g.safetensors", file_sha256(tmp_path / "f.safetensors"))
    ended = nerg("compile", tmp_path / "f.safetensors", "-o", tmp_path / "h.safetensors", "--resolution", "60")
    assert ended.code == 1 and "multiple of 8" in ended.err and not (tmp_path / "h.safetensors").exists()
    with pytest.raises(NergError, check=mentions("memory")):
        compile_field(tmp_path / "f.safetensors", resolution=256, memory=1)
    ended = nerg("compile", tmp_path / "g.safetensors", "-o", tmp_path / "h.safetensors")
    assert ended.code == 1 and "compiled already" in ended.err
    options = ("-o", tmp_path / "h.safetensors", "--resolution", 16, "--color")
    ended = nerg("compile", tmp_path / "f.safetensors", *options, "--min-psnr", 10)
    assert ended.code == 0 and " dB compared with the networks" in ended.out
    assert "colors" in read_metadata(tmp_path / "h.safetensors")["voxels"]
    ended = nerg("compile", tmp_path / "f.safetensors", *options, "--min-psnr", 100)
    assert ended.code == 0 and "--min-psnr" in ended.err
    assert "colors" not in read_metadata(tmp_path / "h.safetensors")["voxels"]


@pytest.mark.nightly
def test_a_compiled_field_is_as_accurate_as_requested(tmp_path):
    radiance(tmp_path / "f.safetensors", density_scale=5.0)
    recorder = Recorder()
    loose, strict = (
        compile_field(tmp_path / "f.safetensors", min_psnr=psnr, max_depth_error=error, progress=recorder)
        for psnr, error in ((10, 1), (100, None))
    )
    assert loose.provenance["compiled"]["resolution"] == 256
    assert strict.provenance["compiled"]["resolution"] == 512 or "256" in recorder.warnings[0]


def test_a_refined_field_is_reported(tmp_path, nerg):
    occupancy = OccupancyGrid(np.ones((4, 4, 4), bool), ns, 0.1)
    radiance(tmp_path / "f.safetensors", density_scale=1e-2, occupancy=occupancy)
    ended = nerg("refine", tmp_path / "f.safetensors", "-o", tmp_path / "g.safetensors")
    assert ended.code == 0 and "before 100.00 %" in ended.out
    refined = read_metadata(tmp_path / "g.safetensors")["occupancy"]["refined"]
    assert refined["threshold"] == pytest.approx(0.01) and refined["missed"] >= 0
