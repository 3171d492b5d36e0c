"""`nerg demo`, the whole way: on random fields always, on the store's own where they are present."""

import csv
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

import nerg_mi.cli
from nerg_mi.evaluation.gaze_report import judge, read_results
from nerg_mi.rendering.bands import render_channels
from nerg_mi.workflows import demo
from tests.cli.test_render import NERG, interrupt
from tests.pictures import mitsuba_bitmap

NAMES = {
    "occlusion.png",
    "gaze.png",
    "gaze_sphere.png",
    "depth.png",
    "visibility.png",
    "color.png",
    "scene.exr",
    "heatmap.glb",
    "report.html",
    "aoi.csv",
    "run.json",
}
TINY = ("--width", 48, "--spp", 1, "-m", "llvm_ad_rgb")


def nerg(*arguments):
    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main(list(map(str, arguments)))
    return end.value.code or 0


def defines(files):
    return [a for k, v in files.items() for a in ("-D", f"{k}={v}")]


def test01_writes_and_names_everything(rgb, standins, tmp_path, capsys):
    out = tmp_path / "new" / "demo"
    assert nerg("demo", "--out", out, *TINY, *defines(standins)) == 0
    said = capsys.readouterr().out
    assert {p.name for p in out.iterdir()} == NAMES
    assert all(str(out / n) in said for n in NAMES) and "Look at them with: " in said

    bitmap = mitsuba_bitmap(out / "scene.exr")
    fields = [f.name for f in bitmap.struct_()]
    assert set(fields) == {"R", "G", "B", "depth.T", "opacity.Y", "gaze.Y", "visibility.Y"}
    assert bitmap.component_format() == rgb.Struct.Type.Float32 and tuple(bitmap.size()) == (48, 32)

    report = json.loads((out / "run.json").read_text())
    assert report["seed"] == 0 and report["spp"] == 1 and report["variant"] == "llvm_ad_rgb"
    assert {"nerg_mi", "mitsuba", "drjit", "numpy", "libLLVM"} <= set(report["versions"])
    assert set(report["seconds"]) == set(demo.STAGES)
    assert set(report["inputs"]) == {"scene.xml", "store.safetensors", "shoppers.safetensors"}
    # Every object of the store, with its share of what this observer looks at.
    shares = {row["object"]: float(row["observer_share"]) for row in csv.DictReader((out / "aoi.csv").open())}
    assert len(shares) == 30 and all(share >= 0 for share in shares.values()) and 0 < sum(shares.values()) < 1.01
    # Inputs and the seed stand in every picture, and rays and people in the page.
    header = (out / "heatmap.glb").read_bytes()
    assert header[:4] == b"glTF" and all(report["inputs"][n].encode() in header for n in ["shoppers.safetensors"])
    for name in NAMES - {"heatmap.glb", "report.html", "aoi.csv", "run.json"}:
        header = (out / name).read_bytes()
        assert all(digest.encode() in header for digest in report["inputs"].values()) and b'"seed": 0' in header, name
    assert "made of 4,321 rays of 12 people" in (out / "report.html").read_text("utf-8")
    for name, digest in report["outputs"].items():
        assert hashlib.sha256((out / name).read_bytes()).hexdigest() == digest


@pytest.mark.nightly
def test02_equal_seeds_equal_files(rgb, standins, tmp_path):
    def outputs(name, seed):
        options = demo.DemoOptions(defaults=standins, seed=seed, mode="llvm_ad_rgb", width=36, spp=1)
        return demo.make_demo(tmp_path / name, options).report["outputs"]

    first, second, other = outputs("a", 3), outputs("b", 3), outputs("c", 4)
    assert first == second
    assert first["scene.exr"] != other["scene.exr"]


@pytest.mark.parametrize("name", ["field", "gaze"])
def test03_missing_checkpoint_names_the_command(standins, tmp_path, capsys, name):
    files = {**standins, name: str(tmp_path / "nowhere.safetensors")}
    assert nerg("demo", "--out", tmp_path / "out", *TINY, *defines(files)) == 1
    said = capsys.readouterr().err
    assert f"the {name} checkpoint" in said and "python -m nerg_mi.scenes.store.make" in said
    assert not (tmp_path / "out").exists()


def test04_wrong_sizes_are_a_sentence(tmp_path, capsys):
    assert nerg("demo", "--out", tmp_path / "out", "--width", 4) == 1
    assert "at least 12 pixels" in capsys.readouterr().err


@pytest.mark.nightly
def test05_the_store_itself(rgb, tmp_path):
    """Committed checkpoints: the shelf hides what lies behind it, and gaze is what occlusion leaves of it."""
    missing = [f for f in demo.CHECKPOINTS.values() if not (demo.store_scene().parent / f).is_file()]
    if missing:
        pytest.skip(f"{', '.join(missing)} of the store are not made yet: {demo.MAKE}")
    scene = rgb.load_file(str(demo.store_scene()), width="60", height="40")
    without = rgb.load_file(str(demo.store_scene()), width="60", height="40", occlusion="false", radiance="false")
    hidden, plain = (render_channels(s, s.sensors()[demo.CAMERA], 1) for s in (scene, without))
    assert hidden.mask.mean() > 0.99
    seen = hidden.aovs["visibility"]
    assert 0.15 < seen.mean() < 0.6
    # The observer's point and the camera's agree where it is seen; elsewhere gaze is gone.
    assert np.all(hidden.aovs["gaze"][seen == 0] == 0) and plain.aovs["gaze"][seen == 0].max() > 0
    x, y = demo.observer_pixel(scene)
    assert 0 < x < 60 and 0 < y < 40
    small = rgb.load_file(str(demo.store_scene()), sphere_width="64", sphere_height="32")
    sphere = render_channels(small, small.sensors()[demo.SPHERE], 1)
    assert 0.7 < demo.sphere_integral(sphere) < 1.3  # a density over the sphere


def test05b_its_evaluation_is_of_the_field_that_it_carries(standins):
    store = demo.store_scene()
    gaze = store.parent / demo.CHECKPOINTS["gaze"]
    assert demo.evaluation_beside(store, gaze) == [store.parent / "gaze.json"], "run make --stage evaluation"
    # And of no other one.
    assert demo.evaluation_beside(store, Path(standins["gaze"])) == []
    results = read_results(store.parent / "gaze.json")
    verdict = judge(results.rows, results.split, results.people, results.positions)
    assert (
        results.people == 100
        and results.positions == 64
        and verdict.sentence.startswith(
            "Better than position-blind, the strongest baseline, and than nearest rays for known people"
        )
    )


def test06_ctrl_c_ends_it_and_leaves_nothing(standins, tmp_path):
    arguments = [
        *NERG,
        "demo",
        "--out",
        tmp_path / "out",
        "--width",
        "2000",
        "--spp",
        "1000",
        "-m",
        "llvm_ad_rgb",
        *defines(standins),
    ]
    said, code = interrupt(arguments, b"camera")
    assert code == 130 and b"Interrupted." in said
    assert not (tmp_path / "out").exists()
