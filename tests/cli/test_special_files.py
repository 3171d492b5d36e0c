"""A pipe or a device in the place of a file is refused in one sentence: opened, it would block, or fill the memory."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal

import pytest
import trimesh

from nerg_mi.errors import NergError
from nerg_mi.rendering.scene import check_scene_file
from tests.surfaces.meshes import box as box_of

from .test_mendable import ended, rays  # noqa: F401

SUFFIXES = "xml ply obj vol glb spz splat safetensors npz npy exr parquet json csv pth mp4 svs.csv.gz".split()
RAYS = "{i}/rays.npz"
LINES = [
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
    f"train gaze {RAYS} -o {{o}}/a.safetensors --field {{p}}.safetensors",
    f"train gaze {RAYS} -o {{o}}/a.safetensors --field {{p}}.ply",
    f"train gaze {RAYS} -o {{o}}/a.safetensors --scene {{p}}.xml",
    f"train gaze {RAYS} -o {{o}}/a.safetensors --scene {{i}}/scene.xml --align {{p}}.json",
    "train gaze -o {o}/a.safetensors --geometry none --views {p}.json --salience {p}.npz",
    "train radiance {p}.json -o {o}/a.safetensors",
    "eval gaze {p}.safetensors " + RAYS,
    f"align {RAYS} --surface {{p}}.ply -o {{o}}/a.json",
    f"align {RAYS} --surface {{p}}.npy -o {{o}}/a.json",
    f"align {RAYS} --surface {{p}}.csv -o {{o}}/a.json",
    "align --pairs {p}.csv -o {o}/a.json",
    f"align {RAYS} --scene {{p}}.xml -o {{o}}/a.json",
    f"stats {RAYS} -o {{o}}/s --areas {{p}}.json",
    f"stats {RAYS} {{p}}.vol -o {{o}}/s --areas {{i}}/areas.json",
    f"stats {RAYS} -o {{o}}/s --areas {{i}}/areas.json --cohorts {{p}}.csv",
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
    """A file was opened that keeps its reader waiting; no error of a file, which readers would catch."""


@pytest.fixture
def in_time():
    """Ends a test that blocks."""

    def end(*_):
        raise Blocked

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope="module")
def pipes(tmp_path_factory, rays):  # noqa: F811
    """A folder of pipes, and of the files that commands need besides."""
    folder = tmp_path_factory.mktemp("special")
    (folder / "pipes").mkdir()
    for suffix in SUFFIXES:
        os.mkfifo(folder / "pipes" / f"a.{suffix}")
    shutil.copy(rays, folder / "rays.npz")
    trimesh.Trimesh(*box_of((0, 0, 0), (1, 1, 1))).export(folder / "box.ply")
    (folder / "scene.xml").write_text('<scene version="3.0.0"><sensor type="perspective"/></scene>')
    (folder / "areas.json").write_text(json.dumps({"a": [[0, 0, 0], [1, 1, 1]]}))
    return folder


@pytest.mark.parametrize("line", LINES)
def test_a_pipe_as_a_file_of_a_command(rgb, pipes, tmp_path, capsys, in_time, line):
    # Commands look first whether an extra is there, without which there is nothing to check.
    for beginning, extra in (("view", "viser"), ("poses", "pycolmap")):
        if line.startswith(beginning):
            pytest.importorskip(extra)
    if "{p}.parquet" in line:
        pytest.importorskip("pyarrow")
    words = shlex.split(line.format(p=pipes / "pipes" / "a", i=pipes, o=tmp_path))
    code, said = ended(capsys, *words)
    assert code == 1 and "is a pipe; write what comes out of it to a file" in said[-1] and len(said) <= 2, said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", NAMED)
@pytest.mark.parametrize("name", ["pipes/a.ply", "pipes", "/dev/zero"])
def test_what_a_scene_names(pipes, in_time, kind, name):
    path = pipes / "named.xml"
    path.write_text(f'<scene version="3.0.0">{NAMED[kind].replace("NAME", name)}</scene>')
    with pytest.raises(NergError, match="is a (pipe|device|folder)"):
        check_scene_file(path)
