"""`nerg train gaze --views --salience`: a field from images alone, and what is refused."""

import json

import numpy as np
import pytest

from nerg_mi.cli import main

QUICK = ["--geometry", "none", "--steps", "2", "--directions", "64", "--zones", "0"]


@pytest.fixture
def folder(tmp_path, rgb):
    """Six photos from places a metre apart, of which five have salience images."""
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
    return tmp_path


def run(*arguments):
    with pytest.raises(SystemExit) as end:
        main(["train", "gaze", *map(str, arguments)])
    return end.value.code


@pytest.mark.parametrize("recipe", ["default", "small"])
def test_a_field_from_images(recipe, folder, capsys, rgb):
    from nerg_mi.fields.mlp import namespace
    from nerg_mi.formats.fields import load_gaze

    # A place, which small needs, is a scene of one wall.
    scene, out = folder / "wall.xml", folder / "out.safetensors"
    scene.write_text('<scene version="3.0.0"><shape type="cube"/></scene>')
    place = QUICK if recipe == "default" else ["--scene", scene, *QUICK[2:]]
    code = run("--views", folder, "--salience", folder / "maps", "--recipe", recipe, *place, "-o", out)
    said = capsys.readouterr()
    assert code in (0, None), said.err
    assert "5 views with salience; without: p0.png" in said.out and "0 probes and 5 views" in said.out
    field, meta = load_gaze(out, namespace("llvm"))
    assert (
        field.config.normalized
        and meta["provenance"]["salience"]["used"] == 5
        and "rays_file" not in meta["provenance"]
    )


@pytest.mark.parametrize(
    "given, said",
    [
        ([], "say what to learn from"),
        (["--views", "{}"], "both: --views"),
        (["--views", "{}", "--salience", "{}/maps", "--geometry", "hits"], "--geometry hits, .* belong to rays"),
        (["--views", "{}", "--salience", "{}/maps", "--test-zones", "2"], "belong to rays"),
        (["--views", "{}", "--salience", "{}/no"], "no folder"),
        (["--views", "{}", "--salience", "{}"], "in colours"),
        (["--views", "{}", "--salience", "{}/maps", "--salience-per", "degree"], 'not per "degree"'),
    ],
)
def test_wrong_options_are_told_in_a_sentence(given, said, folder, capsys):
    import re

    given = [g.format(folder) for g in given]
    assert run(*given, *([] if "hits" in given else QUICK), "-o", folder / "out.safetensors") == 1
    assert re.search(said, " ".join(capsys.readouterr().err.split()))
