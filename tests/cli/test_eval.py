"""`nerg eval radiance` on a data set of two views."""

import json

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.cli import main
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.radiance import RadianceConfig, RadianceField
from nerg_mi.formats.fields import save_radiance
from nerg_mi.maths.geometry import Box


@pytest.fixture
def place(tmp_path):
    """An opaque grey cube of density 50 seen by 3 cameras, whose photos are grey of 0.5; and the field that it is."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    config = RadianceConfig(
        grid=HashGridConfig(levels=2, log2_rows=8, base=4, finest=8), width=16, color_hidden=1, density_scale=50.0
    )
    field = RadianceField.random(config, Box((-1, -1, -1), (1, 1, 1)), ns, 0, march_step=0.05)
    field.set_parameters({k: type(v)(np.zeros(v.shape, np.float32)) for k, v in field.parameters().items()})
    frames = []
    for k in range(3):
        mi.Bitmap(np.full((14, 16, 3), 128, np.uint8)).write(str(tmp_path / f"{k}.png"))
        pose = np.eye(4)
        pose[:3, 3] = 0.05 * k, 0, 3
        frames.append({"file_path": f"{k}.png", "transform_matrix": pose.tolist()})
    about = {
        "w": 16,
        "h": 14,
        "fl_x": 60.0,
        "fl_y": 60.0,
        "cx": 8.0,
        "cy": 7.0,
        "frames": frames,
        "aabb": [[-1, -1, -1], [1, 1, 1]],
    }
    (tmp_path / "transforms.json").write_text(json.dumps(about))
    save_radiance(field, tmp_path / "cube.safetensors", {})
    return tmp_path


def test_scores_and_files(place, capsys):
    with pytest.raises(SystemExit) as end:
        main(
            [
                "eval",
                "radiance",
                str(place / "cube.safetensors"),
                str(place),
                "--holdout",
                "2",
                "--json",
                str(place / "s.json"),
            ]
        )
    assert not end.value.code
    scores = json.loads((place / "s.json").read_text())
    assert scores["width"] == 16 and scores["height"] == 14 and scores["views"]
    assert scores["psnr_mean"] == pytest.approx(-20 * np.log10(128 / 255 - 0.5), abs=1.5)
    assert len(scores["psnr"]) == len(scores["views"]) == len(list((place / "cube.eval").iterdir()))
    assert "mean" in capsys.readouterr().out
