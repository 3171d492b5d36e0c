"""`nerg export`: each form of a small field, and its errors."""

import sys

import pytest
import trimesh
from typer.testing import CliRunner

from nerg_mi.cli import build_app, main
from tests.plugins import fields


@pytest.fixture
def field(tmp_path):
    fields.radiance(tmp_path / "f.safetensors")
    return tmp_path / "f.safetensors"


def run(*arguments):
    return CliRunner().invoke(build_app(), ["export", *map(str, arguments)], catch_exceptions=False)


def test01_mesh_and_points(tmp_path, field):
    out = run("points", field, "-o", tmp_path / "p.ply", "--resolution", 16, "--density", 3, "--count", 50)
    assert out.exit_code == 0 and "50 points" in out.output
    assert len(trimesh.load(tmp_path / "p.ply").vertices) == 50
    pytest.importorskip("skimage")
    out = run("mesh", field, "-o", tmp_path / "m.glb", "--resolution", 16, "--density", 3)
    assert out.exit_code == 0 and "around holes" in out.output and "wrote" in out.output
    assert len(trimesh.load(tmp_path / "m.glb", force="mesh").faces) > 100


def test02_volumes(tmp_path, field):
    out = run("volume", field, "-o", tmp_path / "d.vol", "--color", tmp_path / "c.vol", "--resolution", 8)
    assert out.exit_code == 0 and "8 x 8 x 8 voxels from (-1, -1, -1) to (1, 1, 1)" in out.output
    assert (tmp_path / "c.vol").stat().st_size == 48 + 8**3 * 3 * 4 == 3 * (tmp_path / "d.vol").stat().st_size - 2 * 48


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["mesh", "f.safetensors", "-o", "m.obj"], "end in .ply or .glb"),
        (["points", "f.safetensors", "-o", "p.ply", "--resolution", "8", "--density", "1e9"], "nowhere"),
        (["points", "f.safetensors", "-o", "p.glb", "--up", "x"], "--up must be z or y"),
        (["splats", "f.safetensors", "-o", "s.splat"], "end in .ply"),
        (["volume", "f.safetensors", "-o", "d.exr"], "end in .vol"),
        (["torch-ngp", "f.safetensors", "-o", "x.pth"], "no torch-ngp form"),
        (["volume", "none.safetensors", "-o", "d.vol"], "does not exist"),
    ],
)
def test03_errors_take_a_sentence(field, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(field.parent)
    with pytest.raises(SystemExit) as e:
        main(["export", *arguments])
    said = capsys.readouterr().err
    assert e.value.code == 1 and words in said and said.count("\n") == 1
    assert [p.name for p in field.parent.iterdir()] == ["f.safetensors"]


def test04_without_scikit_image(field, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "skimage.measure", None)
    with pytest.raises(SystemExit) as e:
        main(["export", "mesh", str(field), "-o", str(field.parent / "m.ply"), "--resolution", "8"])
    assert e.value.code == 1 and "nerg-mi[mesh]" in capsys.readouterr().err
