"""`nerg render` on a small scene of stock plugins."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest

import nerg_mi.cli
from tests.pictures import mitsuba_bitmap

SCENE = """
<scene version="3.0.0">
    <default name="integrator" value="path"/>
    <default name="level" value="0.25"/>
    <integrator type="aov"><string name="aovs" value="dd:depth"/><integrator type="$integrator"/></integrator>
    <emitter type="constant"><float name="radiance" value="$level"/></emitter>
    <shape type="sphere"><float name="radius" value="0.3"/></shape>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, 0, -4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><rfilter type="box"/>
            <integer name="width" value="16"/><integer name="height" value="8"/></film>
        <sampler type="independent"><integer name="sample_count" value="2"/></sampler>
    </sensor>
    <sensor type="panorama">
        <film type="hdrfilm"><rfilter type="box"/>
            <integer name="width" value="12"/><integer name="height" value="6"/></film>
    </sensor>
</scene>
"""

NERG = [sys.executable, "-c", "from nerg_mi.cli import main; main()"]
"""The command in a process of its own."""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(SCENE)
    return str(path)


def nerg(*arguments):
    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main(list(map(str, arguments)))
    return end.value.code or 0


def test01_exr_has_all_channels_in_float32(rgb, scene, tmp_path, capsys):
    out = tmp_path / "new" / "out.exr"
    assert nerg("render", scene, "-o", out, "-m", "llvm_ad_rgb") == 0
    assert str(out) in capsys.readouterr().out
    bitmap = mitsuba_bitmap(out)
    assert tuple(bitmap.size()) == (16, 8)
    fields = [field.name for field in bitmap.struct_()]
    assert set("RGB") <= set(fields) and "dd.T" in fields
    assert bitmap.component_format() == rgb.Struct.Type.Float32
    assert np.allclose(np.array(bitmap)[0, 0, :3], 0.25)


def test02_png_is_tonemapped_colour(rgb, scene, tmp_path):
    out = tmp_path / "out.png"
    assert nerg("render", scene, "-o", out, "-m", "llvm_ad_rgb", "-D", "level=0.5") == 0
    picture = np.array(mitsuba_bitmap(out))
    assert picture.shape == (8, 16, 3) and picture.dtype == np.uint8
    assert abs(int(picture[0, 0, 0]) - 188) <= 1  # 0.5 in sRGB


def test03_define_sensor_spp_and_seed(rgb, scene, tmp_path):
    def render(name, *options):
        assert nerg("render", scene, "-o", tmp_path / name, "-m", "llvm_ad_rgb", *options) == 0
        return np.array(mitsuba_bitmap(tmp_path / name))

    assert render("panorama.exr", "-s", 1).shape[:2] == (6, 12)
    assert np.allclose(render("level.exr", "-D", "level=0.75", "-D", "integrator=direct")[0, 0, :3], 0.75)
    a, b, c = (render(f"{i}.exr", "--spp", 1, "--seed", seed) for i, seed in enumerate((3, 3, 4)))
    assert np.array_equal(a, b) and not np.array_equal(a, c)


def test04_mono(rgb, scene, tmp_path):
    out = tmp_path / "mono.exr"
    assert nerg("render", scene, "-o", out, "-m", "llvm_ad_mono") == 0
    assert {"Y", "dd.T"} <= {field.name for field in mitsuba_bitmap(out).struct_()}


@pytest.mark.parametrize(
    "options, said",
    [
        (["-o", "out.bmp"], "let its name end in .exr or .png"),
        (["-o", "out.exr", "-s", "7"], "has 2 sensor(s) and number 7 was asked for"),
        (["-o", "out.exr", "-m", "llvm_rgb"], 'there is no variant "llvm_rgb"'),
        (["-o", "out.exr", "-D", "level"], "write -D key=value"),
        (["-o", "out.exr", "-D", "integrator=nope"], '"nope" not found'),
        (["-o", "out.exr", "-D", "levle=2"], 'asks for no "$levle": correct the name'),
        (["-o", "out.exr", "-m", "scalar_rgb", "-s", "1"], '"panorama" needs a variant that compiles its kernels'),
    ],
)
def test05_one_sentence(scene, tmp_path, monkeypatch, capsys, options, said):
    monkeypatch.chdir(tmp_path)
    assert nerg("render", scene, *options) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("nerg: ") and said in lines[0]
    assert not (tmp_path / "out.exr").exists()


def test05b_a_mistake_of_the_program_while_it_renders_is_told_as_one(scene, tmp_path, monkeypatch, capsys):
    def broken(*args, **options):
        raise RuntimeError(
            'in a plugin:\nTraceback (most recent call last):\n  File "x.py", line 1, in f\nTypeError: no len()'
        )

    monkeypatch.setattr("nerg_mi.rendering.bands.render_bands", broken)
    assert nerg("render", scene, "-o", tmp_path / "out.exr") == 70
    assert "internal error" in capsys.readouterr().err and not (tmp_path / "out.exr").exists()


def test06_missing_scene(tmp_path, capsys):
    assert nerg("render", tmp_path / "nowhere.xml", "-o", tmp_path / "out.exr") == 1
    assert "there is no scene file" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["out.exr", "out.png"])
def test07_one_thread_is_enough(rgb, scene, tmp_path, name):
    # Mitsuba's EXR writer never returns where Dr.Jit has one thread.
    out = tmp_path / name
    subprocess.run([*NERG, "render", scene, "-o", out, "-m", "llvm_ad_rgb", "-t", "1"], check=True, timeout=180)
    assert tuple(mitsuba_bitmap(out).size()) == (16, 8)


@pytest.mark.parametrize("name", ["out.exr", "out.png"])
def test08_a_picture_takes_the_place_of_another_whole(rgb, scene, tmp_path, monkeypatch, name):
    from nerg_mi.files import atomic

    out = tmp_path / name
    out.write_bytes(b"what was there")
    before = set(tmp_path.iterdir())

    def full(path):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(atomic, "_flush", full)
        assert nerg("render", scene, "-o", out, "-m", "llvm_ad_rgb") == 1
    assert out.read_bytes() == b"what was there" and set(tmp_path.iterdir()) == before
    assert nerg("render", scene, "-o", out, "-m", "llvm_ad_rgb") == 0
    assert tuple(mitsuba_bitmap(out).size()) == (16, 8)


@pytest.mark.parametrize("name", ["out.exr", "out.png"])
def test09_ctrl_c_ends_it_and_leaves_nothing(scene, tmp_path, name):
    folder = tmp_path / "pictures"
    large = tmp_path / "large.xml"
    large.write_text(SCENE.replace('value="16"', 'value="3000"').replace('value="8"', 'value="3000"'))
    arguments = [*NERG, "render", large, "-o", folder / name, "-m", "llvm_ad_rgb", "--spp", "256", "--memory", "0.3"]
    said, code = interrupt(arguments, b"samples/s")
    assert code == 130 and b"Interrupted." in said
    assert not list(folder.iterdir())


def interrupt(arguments, sign: bytes) -> tuple[bytes, int]:
    """Run a command on a terminal, press Ctrl-C when it shows `sign`, and give what it showed and its exit code."""
    ours, theirs = os.openpty()
    environment = {**os.environ, "TERM": "xterm-256color", "COLUMNS": "120"}
    child = subprocess.Popen(arguments, stdin=subprocess.DEVNULL, stdout=theirs, stderr=theirs, env=environment)
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


@pytest.mark.parametrize("memory", [1.0, 1e-3])
def test10_memory_changes_no_pixel(rgb, scene, tmp_path, memory):
    def render(name, *options):
        assert nerg("render", scene, "-o", tmp_path / name, "-m", "llvm_ad_rgb", "--spp", 3, *options) == 0
        return np.array(mitsuba_bitmap(tmp_path / name))

    loaded = rgb.load_file(scene)
    rgb.render(loaded, spp=3)
    assert np.array_equal(render("a.exr", "--memory", memory), np.array(loaded.sensors()[0].film().bitmap()))
    assert np.array_equal(render("a.png", "--memory", memory), render("b.png"))


def test11_one_piece_beyond_the_memory_is_said(rgb, scene, tmp_path, capsys):
    other = tmp_path / "other.xml"
    other.write_text(SCENE.replace('type="independent"', 'type="multijitter"'))
    assert nerg("render", other, "-o", tmp_path / "a.exr", "-m", "llvm_ad_rgb", "--memory", 1e-3) == 0
    assert (
        "in one piece, beyond 0.001 GB, because of the sampler MultijitterSampler"
        in capsys.readouterr().out.replace("\n", " ")
    )


def test12_memory_of_nothing(scene, tmp_path, capsys):
    assert nerg("render", scene, "-o", tmp_path / "a.exr", "--memory", 0) == 2
    assert "--memory" in capsys.readouterr().err
