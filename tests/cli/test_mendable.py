"""What users get wrong by options ends in one sentence and exit code 1, from whatever depth it is refused."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.cli import main
from nerg_mi.rays.rays import Rays


@pytest.fixture(scope="module")
def rays(tmp_path_factory):
    rng = np.random.default_rng(0)
    d = rng.normal(size=(200, 3))
    path = tmp_path_factory.mktemp("rays") / "rays.npz"
    Rays(
        np.arange(200),
        np.zeros(200),
        ("a",),
        rng.uniform(-1, 1, (200, 3)),
        d / np.linalg.norm(d, axis=1, keepdims=True),
        np.ones(200),
    ).save(path)
    return path


def ended(capsys, *arguments) -> tuple[int, list[str]]:
    with pytest.raises(SystemExit) as end:
        main([str(a) for a in arguments])
    return end.value.code, capsys.readouterr().err.strip().splitlines()


@pytest.mark.parametrize(
    "more, said",
    [
        (["--variant", "both"], "give other values by --variant and --activation"),
        (["--recipe", "small", "--activation", "sine"], "give other values by --variant and --activation"),
        (["--recipe", "large"], "the recipe must be one of default, small, paper"),
        (["--recipe", "small", "--loss", "none"], "the loss must be one of"),
        (["--mode", "scalar_rgb"], 'not "scalar_rgb"'),
        (["--mode", "llvm_rgb"], 'there is no variant "llvm_rgb"'),
        (["--ensemble", "1"], "at least two members"),
    ],
)
def test01_training_of_gaze(rgb, rays, tmp_path, capsys, more, said):
    code, lines = ended(
        capsys, "train", "gaze", rays, "--geometry", "none", "-o", tmp_path / "g.safetensors", "--steps", "1", *more
    )
    assert code == 1 and lines[-1].startswith("nerg: ") and said in lines[-1]
    assert not any("Traceback" in line for line in lines) and not list(tmp_path.glob("*.safetensors"))


@pytest.mark.parametrize(
    "command, more",
    [("eval", ("radiance", "f.safetensors", "folder")), ("study", ("slab", "-o", "out", "--only", "("))],
)
def test02_other_commands(rgb, tmp_path, capsys, monkeypatch, command, more):
    monkeypatch.chdir(tmp_path)
    code, lines = ended(capsys, command, *more)
    assert (
        code == 1
        and lines[-1].startswith("nerg: ")
        and "internal error" not in lines[-1]
        and not list(tmp_path.iterdir())
    )


def test03_parameters_of_a_scene(rgb, tmp_path, capsys):
    """A plugin's sentence arrives through Mitsuba's own exception, which quotes the traceback of ours."""
    path = tmp_path / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><integrator type="nerg"><string name="depth" value="deep"/></integrator>'
        '<sensor type="perspective"/></scene>'
    )
    code, lines = ended(capsys, "render", path, "-o", tmp_path / "a.exr", "-m", "llvm_ad_rgb")
    assert code == 1 and lines[-1].endswith("\"depth\" must be one of expected, median, refined, got 'deep'")
