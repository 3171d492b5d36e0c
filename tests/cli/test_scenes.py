"""Commands that render, draw and measure: arguments of their workflows, output files and messages."""

from __future__ import annotations

import csv
import importlib.util
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nerg_mi.cli.table import ROWS
from nerg_mi.errors import NergError
from nerg_mi.evaluation.study import COLUMNS
from nerg_mi.files import atomic
from nerg_mi.files.images import write_exr
from nerg_mi.formats.ply import write_columns
from nerg_mi.tasks import cluster
from nerg_mi.tasks.engines import LocalEngine, run_plan
from nerg_mi.tasks.store import Store
from nerg_mi.threads import THREADS_VARIABLE
from nerg_mi.tracking.rays import Rays
from nerg_mi.train import poses as posing
from tests.aoi.place import people, write_place
from tests.figures.test_floor_plans import WALLS_SCENE, make_walk
from tests.photos import rendered
from tests.pictures import SCENE, mitsuba_bitmap
from tests.surfaces.meshes import box
from tests.tasks import works

NERG = [sys.executable, "-c", "from nerg_mi.cli import main; main()"]
"""The command in a process of its own."""
LLVM = ("-m", "llvm_ad_rgb")


def interrupt(arguments, sign: bytes) -> tuple[bytes, int]:
    """Run a command on a terminal, press Ctrl-C when it shows `sign`, and return its output and its exit code."""
    ours, theirs = os.openpty()
    environment = {**os.environ, "TERM": "xterm-256color", "COLUMNS": "120"}
    command = [*NERG, *map(str, arguments)]
    child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=theirs, stderr=theirs, env=environment)
    os.close(theirs)
    said = b""
    try:
        while True:
            try:
                part = os.read(ours, 4096)
            except OSError:  # the terminal is closed
                break
            said += part
            if part and sign in said and sign not in said[: -len(part)]:
                child.send_signal(signal.SIGINT)
        return said, child.wait(timeout=120)
    finally:
        child.kill()
        os.close(ours)


# ---- nerg render ----


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(SCENE)
    return path


@pytest.fixture
def render(scene, tmp_path, nerg):
    """A function that renders the scene to a file and returns its content."""

    def picture(name, *options, mode="llvm_ad_rgb", path=scene):
        ended = nerg("render", path, "-o", tmp_path / name, "-m", mode, *options)
        assert ended.code == 0 and str(tmp_path / name) in ended.out, ended.err
        return mitsuba_bitmap(tmp_path / name)

    return picture


def test_exr_has_all_channels_in_float32(rgb, render):
    bitmap = render("new/out.exr")
    assert tuple(bitmap.size()) == (16, 8)
    fields = [field.name for field in bitmap.struct_()]
    assert set("RGB") <= set(fields) and "dd.T" in fields
    assert bitmap.component_format() == rgb.Struct.Type.Float32
    assert np.allclose(np.array(bitmap)[0, 0, :3], 0.25)
    assert {"Y", "dd.T"} <= {field.name for field in render("mono.exr", mode="llvm_ad_mono").struct_()}


def test_png_is_tonemapped_colour(render):
    picture = np.array(render("out.png", "-D", "level=0.5"))
    assert picture.shape == (8, 16, 3) and picture.dtype == np.uint8
    assert abs(int(picture[0, 0, 0]) - 188) <= 1  # 0.5 in sRGB


def test_define_sensor_and_spp(render):
    assert np.array(render("panorama.exr", "-s", 1)).shape[:2] == (6, 12)
    assert np.allclose(np.array(render("level.exr", "-D", "level=0.75", "-D", "integrator=direct"))[0, 0, :3], 0.75)
    a, b, c = (np.array(render(f"{i}.exr", "--spp", spp)) for i, spp in enumerate((1, 1, 2)))
    assert np.array_equal(a, b) and not np.array_equal(a, c)


def test_an_internal_error_during_rendering_is_reported_as_one(scene, tmp_path, monkeypatch, nerg):
    def broken(*args, **options):
        raise RuntimeError(
            'in a plugin:\nTraceback (most recent call last):\n  File "x.py", line 1, in f\nTypeError: no len()'
        )

    monkeypatch.setattr("nerg_mi.environment.bands.render_bands", broken)
    ended = nerg("render", scene, "-o", tmp_path / "out.exr")
    assert ended.code == 70 and "internal error" in ended.err and not (tmp_path / "out.exr").exists()


@pytest.mark.parametrize("name", ["out.exr", "out.png"])
def test_one_thread_is_enough(scene, tmp_path, name):
    # Mitsuba's EXR writer never returns if Dr.Jit has one thread.
    out = tmp_path / name
    subprocess.run([*NERG, "render", scene, "-o", out, *LLVM, "--threads", "1"], check=True, timeout=180)
    assert tuple(mitsuba_bitmap(out).size()) == (16, 8)


def test_a_scene_without_fields_needs_no_compiled_variant(tmp_path):
    film = '<film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="8"/></film>'
    content = f'<integrator type="path"/><sensor type="perspective">{film}</sensor><emitter type="constant"/>'
    (tmp_path / "a.xml").write_text(f'<scene version="3.0.0">{content}</scene>')
    subprocess.run([*NERG, "render", tmp_path / "a.xml", "-o", tmp_path / "a.exr", "-m", "scalar_rgb"], check=True)
    assert tuple(mitsuba_bitmap(tmp_path / "a.exr").size()) == (16, 8)


@pytest.mark.parametrize("name", ["out.exr", "out.png"])
def test_an_image_replaces_another_atomically(scene, tmp_path, monkeypatch, nerg, render, name):
    out = tmp_path / name
    out.write_bytes(b"what was there")
    before = set(tmp_path.iterdir())

    def full(path):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(atomic, "_flush", full)
        assert nerg("render", scene, "-o", out, *LLVM).code == 1
    assert out.read_bytes() == b"what was there" and set(tmp_path.iterdir()) == before
    assert tuple(render(name).size()) == (16, 8)


@pytest.mark.parametrize("name", ["out.exr", "out.png"])
def test_ctrl_c_ends_a_rendering_and_leaves_no_file(tmp_path, name):
    folder = tmp_path / "pictures"
    large = tmp_path / "large.xml"
    large.write_text(SCENE.replace('value="16"', 'value="3000"').replace('value="8"', 'value="3000"'))
    said, code = interrupt(["render", large, "-o", folder / name, *LLVM, "--spp", 256, "--memory", 0.3], b"samples/s")
    assert code == 130 and b"Interrupted." in said
    assert not list(folder.iterdir())


@pytest.mark.parametrize("memory", [1.0, 1e-3])
def test_memory_changes_no_pixel(rgb, scene, render, memory):
    loaded = rgb.load_file(str(scene))
    rgb.render(loaded, spp=3)
    options = ("--spp", 3, "--memory", memory)
    assert np.array_equal(np.array(render("a.exr", *options)), np.array(loaded.sensors()[0].film().bitmap()))
    assert np.array_equal(np.array(render("a.png", *options)), np.array(render("b.png", "--spp", 3)))


def test_a_tile_beyond_the_memory_limit_is_reported(tmp_path, nerg):
    other = tmp_path / "other.xml"
    other.write_text(SCENE.replace('type="independent"', 'type="multijitter"'))
    ended = nerg("render", other, "-o", tmp_path / "a.exr", *LLVM, "--memory", 1e-3)
    words = "in one piece, above 0.001 GB, because of the sampler MultijitterSampler"
    assert ended.code == 0 and words in ended.out.replace("\n", " ")
    ended = nerg("render", other, "-o", tmp_path / "b.exr", "--memory", 0)
    assert ended.code == 2 and "--memory" in ended.err


# ---- nerg draw, nerg scene, nerg view, nerg report ----


def test_help_names_every_kind_of_figure_and_its_options(nerg):
    said = nerg("draw", "--help").out
    figures = [row for name, row in ROWS.items() if name.startswith("draw ")]
    assert len(figures) == 8 and all(row.name.split()[1] in said and row.line in said for row in figures)
    said = nerg("draw", "sphere", "--help").out
    assert all(flag in said for flag in ("--projection", "--vmax", "--cmap", "-D", "--output", "--width"))
    assert "-D" not in nerg("draw", "sheet", "--help").out


def test_a_difference_of_two_images_is_drawn(nerg, tmp_path):
    for k in (1.0, 2.0):
        write_exr(tmp_path / f"{k:.0f}.exr", {"gaze.Y": np.full((20, 30), k, np.float32)})
    out = tmp_path / "new" / "a.svg"
    ended = nerg("draw", "difference", tmp_path / "1.exr", tmp_path / "2.exr", "-o", out, "--vmax", 3)
    assert ended.code == 0 and f"Wrote {out}" in ended.out and b"<svg" in out.read_bytes()


def test_a_figure_accepts_scene_parameters(nerg, tmp_path):
    make_walk().save(tmp_path / "rays.npz")
    text = WALLS_SCENE.replace('<scene version="3.0.0">', '<scene version="3.0.0"><default name="tall" value="1"/>')
    (tmp_path / "scene.xml").write_text(text.replace('y="0.2" z="1"', 'y="0.2" z="$tall"'))
    line = ("draw", "floor", tmp_path / "rays.npz", "--scene", tmp_path / "scene.xml", "-o")
    for k, defines in enumerate(((), ("-D", "tall=0.1"))):
        assert nerg(*line, tmp_path / f"{k}.png", *defines).code == 0
    assert (tmp_path / "0.png").read_bytes() != (tmp_path / "1.png").read_bytes()
    ended = nerg(*line, tmp_path / "a.png", "-D", "tal=0.1")
    assert ended.code == 1 and 'does not use "$tal"' in ended.err


def test_a_mesh_becomes_a_picture(nerg, tmp_path):
    (tmp_path / "a.obj").write_text("v -1 -1 0\nv 1 -1 0\nv 0 1 0\nf 1 2 3\n")
    path = tmp_path / "new" / "scene.xml"
    ended = nerg("scene", tmp_path / "a.obj", "-o", path, "--camera=0,-3,2", "--target=0,0,0")
    assert ended.code == 0 and f"wrote {path}" in " ".join(ended.out.split())
    assert (
        nerg("render", path, "-o", tmp_path / "a.png", *LLVM, "--spp", 4, "-D", "width=24", "-D", "height=16").code == 0
    )
    picture = np.array(mitsuba_bitmap(tmp_path / "a.png"))
    assert picture.shape == (16, 24, 3) and picture[8, 12].min() > 60 and picture[0, 0].max() == 0


# ---- nerg align, nerg bake, nerg stats, nerg study ----


def test_a_file_of_pairs_becomes_an_alignment_and_a_picture(nerg, tmp_path):
    rows = "0,0,0,1,0,0\n2,0,0,5,0,0\n0,1,0,1,2,0\n0,0,1,1,0,2\n"
    (tmp_path / "p.csv").write_text("x,y,z,place_x,place_y,place_z\n" + rows)
    ended = nerg("align", "--pairs", tmp_path / "p.csv", "-o", tmp_path / "a.json")
    assert not ended.code and "4 pairs" in ended.out and "residuals:" in ended.out
    assert json.loads((tmp_path / "a.json").read_text())["evidence"]["kind"] == "pairs"
    assert (tmp_path / "a.png").is_file()


def test_rays_on_a_room_without_a_wall(nerg, tmp_path):
    v, f = box((0, 0, 0), (4, 3, 2.5), without=1)
    write_columns(tmp_path / "room.ply", dict(zip("xyz", v.T)), f)
    d = np.array([(1.0, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)])
    Rays(np.arange(4) / 10, np.zeros(4), ("a",), np.ones((4, 3)), d, np.ones(4)).save(tmp_path / "a.npz")
    line = f"bake {tmp_path}/room.ply --rays {tmp_path}/a.npz --cone 0 --max-edge 1 -o {tmp_path}/a.json -m llvm_ad_rgb"
    ended = nerg(*line.split(), "--ray-weights", "equal")
    assert not ended.code and "gaze of 4 rays: 75.00% on the surface" in ended.out
    assert "25.00% hits no surface" in ended.out
    assert json.loads((tmp_path / "a.json").read_text())["escaped"] == pytest.approx(0.25)


def test_stats_writes_attention_tables(nerg, tmp_path):
    write_place(tmp_path, gaze=False)
    people().save(tmp_path / "rays.npz")
    line = "stats {o}/rays.npz {o}/scene.xml --aois {o}/areas.json -o {o}/out --window early=0,8 --resamples 199"
    ended = nerg(*line.format(o=tmp_path).split(), *LLVM)
    assert ended.code == 0 and "480 rays of 6 participants" in ended.out + ended.err
    assert "| window early | the sign | measured | 6 |" in (tmp_path / "out" / "aois.md").read_text()


@pytest.mark.nightly
def test_a_quick_study_runs(tmp_path, nerg):
    out = tmp_path / "new"
    ended = nerg(*"study slab --quick --width 24 --height 16 -m llvm_ad_rgb --output".split(), out)
    assert not ended.code
    for name in ("study.csv", "study.md", "scaling.csv", "study.json", "errors.png", "scaling.png"):
        assert (out / name).is_file() and name in ended.out
    with (out / "study.csv").open() as f:
        rows = list(csv.DictReader(f))
    assert tuple(rows[0]) == (*COLUMNS, "note")
    by_name = {r["setting"]: r for r in rows}
    default = by_name["default"]
    assert float(default["seconds"]) > 0 and float(default["density_evals"]) > 100 and float(default["peak_mb"]) > 0
    assert float(default["depth_mae"]) < 1e-5
    # Unneeded evaluations are not run.
    assert float(by_name["no colour"]["color_evals"]) == 0 and by_name["no colour"]["color_rmse"] == ""  # noqa: RUF069 (a count)
    assert float(by_name["no observer"]["density_evals"]) < 0.8 * float(default["density_evals"])
    assert any("depth" in r["pareto"] for r in rows)
    report = json.loads((out / "study.json").read_text())
    assert report["scene"] == "slab" and len(report["rows"]) == len(rows) and report["against_paper"]
    assert {r["axis"] for r in report["scaling"]} == {"pixels", "samples", "extent"}
    paper = next(p for p in report["against_paper"] if p["paper"]["setting"] == "paper, 1024 steps")
    assert paper["paper"]["depth_mae"] > 1000 * paper["default"]["depth_mae"]


# ---- nerg jobs, nerg worker ----


def test_a_store_is_summarised_and_cleaned(tmp_path, nerg):
    store = Store(tmp_path / "store")
    for count in (3, 1):
        list(run_plan(works.make_plan(count, what="a film"), store, LocalEngine()))
    ended = nerg("jobs", store.folder)
    assert ended.code == 0 and "| a film | 1 | 1 | 0 |" in ended.out and "stale: 2 outputs" in ended.out
    assert len(list(store.iter_manifests())) == 3
    assert "Removed 130 bytes." in nerg("jobs", store.folder, "--remove-stale").out
    assert len(list(store.iter_manifests())) == 1


def test_a_worker_serves_an_address_and_warns_of_an_open_one(monkeypatch, nerg):
    served = []

    async def serve(address, wait, on_message, security):
        served.append((address, wait, os.environ.get(THREADS_VARIABLE)))

    monkeypatch.setattr(cluster, "_serve_async", serve)
    monkeypatch.setattr(cluster, "import_distributed", lambda: None)
    # Settings of the command are restored after the test.
    monkeypatch.setenv(THREADS_VARIABLE, "")
    ended = nerg(*"worker tcp://127.0.0.1:8786 --threads 3".split())
    assert ended.code == 0 and ended.err == ""
    assert served == [("tcp://127.0.0.1:8786", 600.0, "3")]
    assert "warning: tcp://192.0.2.1:8786 is not protected" in nerg("worker", "tcp://192.0.2.1:8786").err


# ---- nerg poses ----


@pytest.fixture
def photos(tmp_path, monkeypatch) -> Path:
    monkeypatch.setattr(posing, "check_installed", lambda: None)
    (tmp_path / "photos").mkdir()
    for k in range(3):
        Image.fromarray(np.full((8, 9, 3), 50 * k, np.uint8)).save(tmp_path / "photos" / f"{k}.png")
    return tmp_path / "photos"


def test_links_are_followed_only_if_allowed(photos, nerg, monkeypatch, tmp_path):
    monkeypatch.setattr(posing, "reconstruct", lambda *args: None)
    (photos / "2.png").rename(tmp_path / "2.png")
    (photos / "2.png").symlink_to(tmp_path / "2.png")
    ended = nerg("poses", photos, "-o", tmp_path / "capture")
    assert ended.code == 1 and "has 2 usable images" in ended.err and "allow_outside=True" in ended.err
    with pytest.raises(NergError, match="no 3 of the 3 images"):
        posing.find_poses(photos, tmp_path / "capture", allow_outside=True)


def test_ctrl_c_ends_poses_and_leaves_no_file(photos, nerg, monkeypatch, tmp_path):
    monkeypatch.setattr(posing, "reconstruct", lambda *args: signal.raise_signal(signal.SIGINT))
    ended = nerg("poses", photos, "-o", tmp_path / "capture")
    assert ended.code == 130 and "Interrupted" in ended.err and os.listdir(tmp_path) == ["photos"]


def test_photos_become_a_capture_that_can_be_trained_on(nerg, tmp_path):
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip('pycolmap is not installed (pip install "nerg-mi[poses]")')
    photos = rendered.write_photos(tmp_path / "photos", 6)
    ended = nerg("poses", photos, "-o", tmp_path / "capture", "--threads", "1")
    assert ended.code == 0 and "6 of 6 images have a pose" in ended.out and "warning" not in ended.err
    assert sorted(os.listdir(tmp_path / "capture")) == ["images", "poses.json", "poses.png", "sparse"]
    ended = nerg("train", "radiance", tmp_path / "capture", "-o", tmp_path / "a.safetensors", "--steps", "2")
    assert not ended.code and "surface points" in ended.out
