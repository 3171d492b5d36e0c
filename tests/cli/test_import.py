"""`nerg import`: both kinds of checkpoints, and its errors."""

import numpy as np
import pytest
from typer.testing import CliRunner

from nerg_mi.cli import build_app, main
from nerg_mi.formats.torch_files import write_torch
from tests.formats.test_torch_ngp import save_nerg as save
from tests.formats.test_torch_ngp import small_gaze, small_state

pytestmark = pytest.mark.usefixtures("torch")


def run(*arguments):
    return CliRunner().invoke(build_app(), ["import", *map(str, arguments)])


def test01_a_nerf(tmp_path):
    write_torch(tmp_path / "ngp.pth", {"model": small_state()})
    out = run(tmp_path / "ngp.pth", "-o", tmp_path / "field.safetensors", "--color-space", "linear")
    assert out.exit_code == 0 and "raw weights, no occupancy grid" in out.output and "wrote" in out.output
    from drjit.llvm import ad as ns

    from nerg_mi.formats.fields import load_radiance

    field, meta = load_radiance(tmp_path / "field.safetensors", ns)
    assert field.color_space == "linear" and meta["provenance"]["format"] == "torch-ngp"
    assert np.array_equal(field.color_net.weights[2].numpy(), small_state()["color_net.2.weight"])


def test02_a_nerf_and_its_gaze(tmp_path):
    path = save(tmp_path / "nerg.pth", small_gaze(), nerf=small_state())
    out = run(path, "-o", tmp_path / "field.safetensors")
    assert out.exit_code == 0 and "also holds a gaze field" in out.output
    out = run(path, "-o", tmp_path / "f.safetensors", "-g", tmp_path / "g.safetensors", "--half")
    assert out.exit_code == 0 and "gaze: emit_capture, trunk layernorm, bound 1" in out.output
    assert (tmp_path / "g.safetensors").stat().st_size < 0.6 * small_gaze()["encoder.embeddings"].nbytes + 1e5


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["ngp.pth"], "nothing is asked for"),
        (["ngp.pth", "-g", "g.safetensors"], "holds no gaze field"),
        (["nerg.pth", "-o", "f.safetensors"], "without its NeRF"),
        (["ngp.pth", "-o", "f.safetensors", "--ema"], "no moving averages"),
        (["ngp.pth", "-o", "f.safetensors", "--color-space", "xyz"], "color_space"),
        (["none.pth", "-o", "f.safetensors"], "no file"),
    ],
)
def test03_errors_take_a_sentence(tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    write_torch("ngp.pth", {"model": small_state()})
    save("nerg.pth", small_gaze())
    with pytest.raises(SystemExit) as e:
        main(["import", *arguments])
    said = capsys.readouterr().err
    assert e.value.code == 1 and words in said and said.count("\n") == 1
    assert not list(tmp_path.glob("*.safetensors"))
