"""Mistakes of users end in one sentence and exit code 1, wherever they are detected, and nothing is written."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import sys

import numpy as np
import pytest
import trimesh
from PIL import Image

from nerg_mi.environment.scene_loading import check_scene_file
from nerg_mi.errors import NergError
from nerg_mi.formats.torch_files import write_torch
from nerg_mi.photos import structure
from nerg_mi.tracking.rays import Rays
from nerg_mi.train import poses
from tests.formats.test_torch_ngp import save_nerg as save
from tests.formats.test_torch_ngp import small_gaze, small_state
from tests.pictures import SCENE
from tests.plugins import fields
from tests.surfaces.meshes import box as box_of

from .outputs import HAS_TORCH

DEEP = '<scene version="3.0.0"><integrator type="nerg"><string name="depth" value="deep"/></integrator>'


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A folder of files that command lines name."""
    folder = tmp_path_factory.mktemp("small")
    (folder / "scene.xml").write_text(SCENE)
    (folder / "deep.xml").write_text(DEEP + '<sensor type="perspective"/></scene>')
    (folder / "a.obj").write_text("v -1 -1 0\nv 1 -1 0\nv 0 1 0\nf 1 2 3\n")
    (folder / "areas.json").write_text(json.dumps({"a": [[0, 0, 0], [1, 1, 1]]}))
    rng = np.random.default_rng(0)
    d = rng.normal(size=(200, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    Rays(np.arange(200), np.zeros(200), ("a",), rng.uniform(-1, 1, (200, 3)), d, np.ones(200)).save(folder / "rays.npz")
    trimesh.Trimesh(*box_of((0, 0, 0), (1, 1, 1))).export(folder / "box.ply")
    fields.radiance(folder / "f.safetensors")
    if HAS_TORCH:
        write_torch(folder / "ngp.pth", {"model": small_state()})
        save(folder / "nerg.pth", small_gaze())
    for name in ("photos", "maps", "empty"):
        (folder / name).mkdir()
    frames = []
    for k in range(3):
        Image.fromarray(rng.integers(0, 255, (12, 16, 3)).astype(np.uint8)).save(folder / "photos" / f"{k}.png")
        np.save(folder / "maps" / f"{k}.npy", rng.uniform(size=(12, 16)))
        pose = np.eye(4)
        pose[0, 3] = k
        frames.append({"file_path": f"{k}.png", "transform_matrix": pose.tolist()})
    (folder / "photos" / "transforms.json").write_text(json.dumps({"camera_angle_x": 1.0, "frames": frames}))
    return folder


GAZE = "train gaze rays.npz -o {o}/a.safetensors --environment none --steps 1"
VIEWS = "train gaze -o {o}/a.safetensors --steps 2"
PHOTOS = f"{VIEWS} --environment none --views photos"
LINES = {
    # Options that contradict each other, or have invalid values.
    f"{GAZE} --variant both": "--variant must be",
    f"{GAZE} --mode scalar_rgb": 'not "scalar_rgb"',
    f"{GAZE} --mode llvm_rgb": 'there is no Mitsuba variant "llvm_rgb"',
    f"{GAZE} --ensemble 1": "at least two members",
    f"{PHOTOS} --salience no": 'the folder "no" of salience images does not exist',
    f"{PHOTOS} --salience photos": "has colours",
    "train radiance empty -o {o}/a.safetensors --resume": "no state to resume",
    "train radiance empty -o {o}/a.safetensors --steps 5 --minutes 1": "--minutes and --steps are alternatives",
    "eval radiance no.safetensors photos -o {o}/a": "does not exist",
    "scene a.obj -o {o}/a.png": r"choose a file name that ends in \.xml",
    "scene a.obj -o {o}/a.xml --observer 1,2": "--observer must be three numbers",
    "render scene.xml -o {o}/a.bmp": r"choose a file name that ends in \.exr or \.png",
    "render scene.xml -o {o}/a.exr -s 7": r"has 2 sensor\(s\), and --sensor 7 is out of range",
    "render scene.xml -o {o}/a.exr -D level": "write KEY=VALUE",
    "render scene.xml -o {o}/a.exr -D integrator=nope": '"nope" not found',
    "render scene.xml -o {o}/a.exr -D levle=2": r'does not use "\$levle"; correct the name',
    "render scene.xml -o {o}/a.exr -m scalar_rgb -s 1": '"panorama" needs a variant with',
    "render none.xml -o {o}/a.exr": "there is no scene file",
    # The message of a plugin arrives in an exception of Mitsuba, which quotes the traceback of the original.
    "render deep.xml -o {o}/a.exr -m llvm_ad_rgb": "\"depth\" must be one of expected, median, refined, got 'deep'$",
    "draw sheet gone.png -o {o}/a.png": "there is no file",
    "draw sphere gone.xml -o {o}/a.gif": r"ends in \.png or \.svg",
    "study nowhere -o {o}/a": '"nowhere" is neither a scene file',
    "study slab -o {o}/a --only 'nothing of it'": 'no setting matches "nothing of it"',
    "study slab -o {o}/a --only (": r'"\(" is not a regular expression',
    "stats rays.npz -o {o}/a": "--aois FILE",
    "report no.safetensors -o {o}/a.html": "there is no file or folder",
    "jobs empty": "contains no parts of jobs",
    "worker somewhere": "is not a scheduler address",
    "export mesh f.safetensors -o {o}/a.obj": r"ends in \.ply or \.glb",
    "export mesh f.safetensors -o {o}/a.ply --resolution 8 --density-threshold 1e9": "does not cross|scikit",
    "export points f.safetensors -o {o}/a.glb --up x": "--up must be",
    "export splats f.safetensors -o {o}/a.splat": r"ends in \.ply",
    "export volume f.safetensors -o {o}/a.exr": r"ends in \.vol",
    "export points f.safetensors -o {o}/a.ply --mode no": r"no Mitsuba variant \"no\"",
    "export torch-ngp f.safetensors -o {o}/a.pth": "torch-ngp cannot represent this field",
    "import ngp.pth": "no output is given",
    "import ngp.pth -g {o}/g.safetensors": "contains no gaze field",
    "import nerg.pth -o {o}/a.safetensors": "a gaze field but no NeRF",
    "import ngp.pth -o {o}/a.safetensors --color-space xyz": "--color-space must be",
    "poses photos/0.png -o {o}/a": "is a single photo",
    "poses photos/nowhere -o {o}/a": "there is no video",
    "poses empty -o {o}/a": "contains no photos",
    "poses photos -o {o}/a --camera-model fish": "--camera-model must be",
    "poses photos -o photos": "not empty: choose another name, or remove it",
    "poses photos -o rays.npz": "is a file",
}
WITHOUT = {
    "export mesh f.safetensors -o {o}/a.ply --resolution 8": ("skimage.measure", "nerg-mi[mesh]"),
    "poses photos -o {o}/a": ("pycolmap", 'pip install "nerg-mi[poses]"'),
    "view scene.xml": ("viser", 'pip install "nerg-mi[viewer]"'),
}
"""Command lines -> a module of an extra, without which they say how it is installed."""


@pytest.mark.parametrize("line", LINES)
def test_a_user_error_is_one_sentence(line, small, nerg, tmp_path, monkeypatch):
    if line.startswith(("import", "export torch")):
        pytest.importorskip("torch")
    for module in (poses, structure):
        monkeypatch.setattr(module, "check_installed", lambda: None)
    monkeypatch.chdir(small)
    before = sorted(small.rglob("*"))
    ended = nerg(*shlex.split(line.format(o=tmp_path)))
    lines = ended.err.strip().splitlines()
    assert ended.code == 1 and lines[-1].startswith("nerg: "), ended
    assert len(lines) == 1 and "internal error" not in ended.err
    assert re.search(LINES[line], ended.err.strip(), re.S)
    assert not list(tmp_path.iterdir()) and sorted(small.rglob("*")) == before


@pytest.mark.parametrize("line", WITHOUT)
def test_a_missing_extra_is_named(line, small, nerg, tmp_path, monkeypatch):
    module, said = WITHOUT[line]
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.chdir(small)
    ended = nerg(*line.format(o=tmp_path).split())
    assert ended.code == 1 and said in " ".join(ended.err.split()) and not list(tmp_path.iterdir())


# ---- A pipe or a device in place of a file: reading it would block, or fill the memory ----


SUFFIXES = "xml ply obj vol glb spz splat safetensors npz npy exr parquet json csv pth mp4 svs.csv.gz".split()
RAYS = "{i}/rays.npz"
PIPES = [
    "render {p}.xml -o {o}/a.png",
    "render {i}/scene.xml -o {o}/a.png --frames {p}.csv",
    *[f"scene {{p}}.{kind} -o {{o}}/a.xml" for kind in "xml ply obj vol glb spz splat safetensors npz parquet".split()],
    f"scene {RAYS} -o {{o}}/a.xml --align {{p}}.json",
    "view {p}.xml",
    "draw surface {p}.ply -o {o}/a.png",
    "draw difference {p}.exr {p}.exr -o {o}/a.png",
    "rays import {p}.csv -o {o}/a.npz --preset unity",
    "rays import {p}.parquet -o {o}/a.rays --map 'origin=x,y,z direction=a,b,c t=t person=p'",
    "rays import {p}.svs.csv.gz -o {o}/a.npz --preset unity",
    "rays guess {p}.csv",
    "rays show {p}.npz",
    "rays show {p}.parquet",
    f"train gaze {RAYS} -o {{o}}/a.safetensors --environment {{p}}.safetensors",
    f"train gaze {RAYS} -o {{o}}/a.safetensors --environment {{p}}.ply",
    f"train gaze {RAYS} -o {{o}}/a.safetensors --environment {{p}}.xml",
    f"train gaze {RAYS} -o {{o}}/a.safetensors --environment {{i}}/scene.xml --align {{p}}.json",
    "train gaze -o {o}/a.safetensors --environment none --views {p}.json --salience {p}.npz",
    "train radiance {p}.json -o {o}/a.safetensors",
    "eval gaze {p}.safetensors " + RAYS,
    f"align {RAYS} --surface {{p}}.ply -o {{o}}/a.json",
    f"align {RAYS} --surface {{p}}.npy -o {{o}}/a.json",
    f"align {RAYS} --surface {{p}}.csv -o {{o}}/a.json",
    "align --pairs {p}.csv -o {o}/a.json",
    f"align {RAYS} --environment {{p}}.xml -o {{o}}/a.json",
    f"stats {RAYS} -o {{o}}/s --aois {{p}}.json",
    f"stats {RAYS} {{p}}.vol -o {{o}}/s --aois {{i}}/areas.json",
    f"stats {RAYS} -o {{o}}/s --aois {{i}}/areas.json --cohorts {{p}}.csv",
    "report {p}.safetensors -o {o}/a.html",
    "import {p}.pth -o {o}/a.safetensors",
    "export mesh {p}.safetensors -o {o}/a.ply",
    "refine {p}.safetensors -o {o}/a.safetensors",
    *[f"bake {{p}}.{kind} --rays {RAYS} -o {{o}}/a.ply" for kind in ("ply", "obj", "glb", "xml", "safetensors")],
    "bake {i}/box.ply --rays {p}.npz -o {o}/a.ply",
    "study {p}.xml -o {o}/s",
    "poses {p}.mp4 -o {o}/s",
]
NAMED = {
    "include": '<include filename="NAME"/>',
    **{k: f'<shape type="{k}"><string name="filename" value="NAME"/></shape>' for k in ("ply", "obj", "serialized")},
    **{
        k: f'<integrator type="nerg"><volume name="field" type="{k}"><string name="filename" value="NAME"/></volume>'
        "</integrator>"
        for k in ("nerf", "splats", "gazefield", "gazekde", "gridvolume")
    },
    "envmap": '<emitter type="envmap"><string name="filename" value="NAME"/></emitter>',
    "bitmap": '<texture type="bitmap"><string name="filename" value="NAME"/></texture>',
    "spectrum": '<emitter type="constant"><spectrum name="radiance" filename="NAME"/></emitter>',
    "default": '<default name="f" value="NAME"/><shape type="ply"><string name="filename" value="$f"/></shape>',
    "path": '<path value="pipes"/><shape type="ply"><string name="filename" value="a.ply"/></shape>',
}


class Blocked(BaseException):
    """A file that blocks its reader was opened. This is not an ``OSError``, which readers would catch."""


@pytest.fixture
def in_time():
    """End a test that blocks."""

    def end(*_):
        raise Blocked

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(120)  # on a busy machine, a command that works may take half a minute
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope="module")
def pipes(tmp_path_factory, small):
    """A folder of pipes, and of the other files that commands need."""
    folder = tmp_path_factory.mktemp("special")
    (folder / "pipes").mkdir()
    for suffix in SUFFIXES:
        os.mkfifo(folder / "pipes" / f"a.{suffix}")
    for name in ("rays.npz", "box.ply", "areas.json"):
        shutil.copy(small / name, folder)
    (folder / "scene.xml").write_text('<scene version="3.0.0"><sensor type="perspective"/></scene>')
    return folder


@pytest.mark.parametrize("line", PIPES)
def test_a_pipe_as_an_input_file_is_refused(pipes, tmp_path, nerg, in_time, line):
    # Commands first check whether an extra is installed; without it, there is nothing to test.
    for beginning, extra in (("view", "viser"), ("poses", "pycolmap")):
        if line.startswith(beginning):
            pytest.importorskip(extra)
    if "{p}.parquet" in line:
        pytest.importorskip("pyarrow")
    words = shlex.split(line.format(p=pipes / "pipes" / "a", i=pipes, o=tmp_path))
    ended = nerg(*words)
    said = ended.err.strip().splitlines()
    assert ended.code == 1 and "is a pipe; write its output to a file" in said[-1] and len(said) <= 2, said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", NAMED)
@pytest.mark.parametrize("name", ["pipes/a.ply", "pipes", "/dev/zero"])
def test_pipes_referenced_by_a_scene_are_refused(pipes, in_time, kind, name):
    path = pipes / "named.xml"
    path.write_text(f'<scene version="3.0.0">{NAMED[kind].replace("NAME", name)}</scene>')
    with pytest.raises(NergError, match="is a (pipe|device|folder)"):
        check_scene_file(path)
