"""The demo: on random fields, and on the trained fields of the store if they exist."""

from __future__ import annotations

import csv
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from nerg_mi.scenes.store import SCENE_FILE

from nerg_mi.cli import demo
from nerg_mi.environment.bands import render_channels
from nerg_mi.errors import NergError
from nerg_mi.evaluation.gaze_report import compute_verdict, read_results
from nerg_mi.tracking.rays import Rays
from tests.pictures import mitsuba_bitmap
from tests.recorder import Recorder

PICTURES = {"occlusion.png", "gaze.png", "gaze_sphere.png", "depth.png", "visibility.png", "color.png", "scene.exr"}
NAMES = PICTURES | {"heatmap.glb", "report.html", "aoi.csv", "run.json"}
TINY = {"width": 48, "spp": 1}


def test_the_demo_writes_and_names_everything(rgb, standins, tmp_path):
    out, recorder = tmp_path / "new" / "demo", Recorder()
    result = demo.make_demo(out, defaults=standins, **TINY, progress=recorder)
    assert {p.name for p in out.iterdir()} == NAMES and set(result.files) == set(out.iterdir())
    first, *stages, _, command = recorder.messages
    assert str(len(demo.STAGES)) in first and "report.html" in command
    assert stages[: len(demo.STAGES)] == [
        f"{k + 1} of {len(demo.STAGES)}: {text}" for k, (text, _) in enumerate(demo.STAGES.values())
    ]
    assert stages[len(demo.STAGES) :][: len(NAMES)] == [f"wrote {path}" for path in result.files]
    fractions = [share for share, _ in recorder.steps]
    assert fractions == sorted(fractions) and fractions[0] == 0 and fractions[-1] <= 1

    bitmap = mitsuba_bitmap(out / "scene.exr")
    fields = [f.name for f in bitmap.struct_()]
    assert set(fields) == {"R", "G", "B", "depth.T", "opacity.Y", "gaze.Y", "visibility.Y"}
    assert bitmap.component_format() == rgb.Struct.Type.Float32 and tuple(bitmap.size()) == (48, 32)

    report = json.loads((out / "run.json").read_text())
    assert report["seed"] == 0 and report["spp"] == 1 and report["variant"] == "llvm_ad_rgb"
    assert {"nerg_mi", "mitsuba", "drjit", "numpy", "libLLVM"} <= set(report["versions"])
    assert set(report["seconds"]) == set(demo.STAGES)
    assert set(report["inputs"]) == {"scene.xml", "store.safetensors", "shoppers.safetensors"}
    # Every object of the store, with its share of the gaze of this observer.
    shares = {row["object"]: float(row["observer_share"]) for row in csv.DictReader((out / "aoi.csv").open())}
    assert len(shares) == 30 and all(share >= 0 for share in shares.values()) and 0 < sum(shares.values()) < 1.01
    # Each image records inputs and seed; the page records rays and participants.
    header = (out / "heatmap.glb").read_bytes()
    assert header[:4] == b"glTF" and report["inputs"]["shoppers.safetensors"].encode() in header
    for name in PICTURES:
        header = (out / name).read_bytes()
        assert all(digest.encode() in header for digest in report["inputs"].values()) and b'"seed": 0' in header, name
    assert "data: 4,321 rays of 12 participants" in (out / "report.html").read_text("utf-8")
    for name, digest in report["outputs"].items():
        assert hashlib.sha256((out / name).read_bytes()).hexdigest() == digest


@pytest.mark.nightly
def test_equal_seeds_give_equal_demo_files(rgb, standins, tmp_path):
    def outputs(name, seed):
        return demo.make_demo(tmp_path / name, defaults=standins, seed=seed, width=36, spp=1).report["outputs"]

    first, second, other = outputs("a", 3), outputs("b", 3), outputs("c", 4)
    assert first == second
    assert first["scene.exr"] != other["scene.exr"]


@pytest.mark.parametrize("name", ["field", "gaze"])
def test_a_missing_checkpoint_names_the_command(standins, tmp_path, name):
    files = {**standins, name: str(tmp_path / "nowhere.safetensors")}
    with pytest.raises(NergError, match=f"the {name} checkpoint .*python -m nerg_mi.scenes.store"):
        demo.make_demo(tmp_path / "out", defaults=files, **TINY)
    assert not (tmp_path / "out").exists()


@pytest.mark.nightly
def test_the_committed_store_renders_with_occlusion(rgb):
    """Committed checkpoints: the shelf hides the surfaces behind it, where gaze is zero."""
    missing = [f for f in demo.CHECKPOINTS.values() if not (SCENE_FILE.parent / f).is_file()]
    if missing:
        pytest.skip(f"{', '.join(missing)} of the store are not made yet: {demo.MAKE}")
    scene = rgb.load_file(str(SCENE_FILE), width="60", height="40")
    without = rgb.load_file(str(SCENE_FILE), width="60", height="40", occlusion="false", radiance="false")
    hidden, plain = (render_channels(s, s.sensors()[demo.CAMERA], 1) for s in (scene, without))
    assert hidden.mask.mean() > 0.99
    seen = hidden.aovs["visibility"]
    assert 0.15 < seen.mean() < 0.6
    # The points of observer and camera agree on visible surfaces; elsewhere gaze is zero.
    assert np.all(hidden.aovs["gaze"][seen == 0] == 0) and plain.aovs["gaze"][seen == 0].max() > 0
    x, y = demo.observer_pixel(scene)
    assert 0 < x < 60 and 0 < y < 40
    small = rgb.load_file(str(SCENE_FILE), sphere_width="64", sphere_height="32")
    sphere = render_channels(small, small.sensors()[demo.SPHERE], 1)
    assert 0.7 < demo.sphere_integral(sphere) < 1.3  # a density over the sphere


def test_the_demo_evaluation_matches_its_field(standins):
    store = SCENE_FILE
    gaze = store.parent / demo.CHECKPOINTS["gaze"]
    assert demo.find_evaluation(store, gaze) == [store.parent / "gaze.json"], "run make --stage evaluation"
    # The evaluation does not match another field.
    assert demo.find_evaluation(store, Path(standins["gaze"])) == []
    results = read_results(store.parent / "gaze.json")
    verdict = compute_verdict(results.rows, results.split, results.num_participants, results.num_positions)
    assert results.num_participants == 100 and results.num_positions == 64
    assert verdict.sentence.startswith(
        "Better than the re-aimed hits, the strongest baseline, and than the nearest rays"
    )


def test_ctrl_c_ends_the_demo_and_leaves_no_file(standins, tmp_path):
    class Impatient(Recorder):
        def progress(self, share, text=""):
            if text == "camera":
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        demo.make_demo(tmp_path / "out", defaults=standins, **TINY, progress=Impatient())
    assert not (tmp_path / "out").exists()


@pytest.mark.nightly
def test_the_demo_report_contains_the_tracked_gaze(tmp_path):
    """With the field of the store; the values of an observer do not depend on other observers."""
    result = demo.make_demo(tmp_path, width=24, spp=1)
    text = (tmp_path / "report.html").read_text("utf-8")
    rays = Rays.load(tmp_path / demo.TRACKED)
    assert tmp_path / demo.TRACKED in result.files and len(rays.persons) == 100 and len(rays) > 10_000
    assert (
        'id="people"' in text
        and "median number of participants within" in text
        and f"{len(rays):,} of 150,021 rows" in text
    )
    with (tmp_path / "aoi.csv").open() as file:
        shares = np.array([float(row["observer_share"]) for row in csv.DictReader(file)])
    # For one observer, who sees some of the shelves; three observers together would see almost all.
    assert len(shares) == 30 and (shares == 0).sum() > 8 and 0 < shares.sum() < 1
