"""`nerg train gaze`: what it hands on, and fields that take over a radiance field's features and weights."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.cli import main
from nerg_mi.formats.fields import load_gaze, load_radiance
from nerg_mi.workflows import train_gaze  # noqa: F401 (declares the command)
from nerg_mi.workflows.gaze_commands import GazeOptions
from tests.plugins import fields as radiance_fields
from tests.train.gaze.looks import looking_at

from .handed import keep_handed

ASKED = {
    "field": "place.safetensors",
    "scene": "room.xml",
    "geometry": "hits",
    "views": "photos",
    "salience": "maps",
    "salience_per": "steradian",
    "align_views": "a.json",
    "recipe": "small",
    "voxel": 0.5,
    "align": "b.json",
    "radius": 0.3,
    "probes": 7,
    "placement": "grid",
    "cap": 8,
    "min_rays": 3,
    "kappa_rule": "loo",
    "kappa": 12.0,
    "weights": "person",
    "directions": 40,
    "variant": "emit",
    "activation": "exp",
    "size": "paper",
    "semantic": "snapshot",
    "begin": "field",
    "loss": "code",
    "integral": 0.5,
    "minutes": 2.0,
    "steps": 9,
    "learning_rate": 0.1,
    "weight_decay": 0.2,
    "zones": 2,
    "mix_folds": 3,
    "mix_kappa": 15.0,
    "test_zones": 4,
    "test_positions": 5,
    "test_people": 0.5,
    "ensemble": 3,
    "save_every": 7.0,
    "most": 1000,
    "seed": 6,
    "threads": 2,
    "mode": "llvm_ad_mono",
}
FLAGS = {
    "allow_outside": "--allow-outside",
    "fresh": "--fresh-directions",
    "normalized": "--normalized",
    "semantic_own": "--semantic-own",
    "force": "--force",
    "freeze": "--freeze",
    "refit": "--no-refit",
    "resume": "--resume",
    "half": "--half",
}


def nerg(capsys, *arguments):
    """Exit code of `nerg train gaze`, and what it said on the standard error."""
    with pytest.raises(SystemExit) as end:
        main(["train", "gaze", *map(str, arguments)])
    return end.value.code or 0, " ".join(capsys.readouterr().err.split())


def test_the_job_is_given_what_was_asked_for(monkeypatch, capsys):
    """Every option there is, and none of them."""
    given = keep_handed(monkeypatch, "train gaze")
    line = [word for name, value in ASKED.items() for word in ("--" + name.replace("_", "-"), value)]
    assert nerg(capsys, "rays.npz", "-o", "out.safetensors", *line, *FLAGS.values())[0] == 0
    assert nerg(capsys, "-o", "out.safetensors")[0] == 0
    paths = ("field", "scene", "views", "align_views", "align")
    options = GazeOptions(
        **{k: Path(v) if k in paths else v for k, v in ASKED.items()}, **{k: k != "refit" for k in FLAGS}
    )
    output = Path("out.safetensors")
    assert given == [
        {"rays": Path("rays.npz"), "output": output, "options": options},
        {"rays": None, "output": output, "options": GazeOptions()},
    ]
    assert set(ASKED) | set(FLAGS) == {f.name for f in fields(GazeOptions)}


def test_a_field_takes_over_features_and_weights(tmp_path, capsys):
    radiance_fields.radiance(tmp_path / "field.safetensors", density_scale=30.0)
    radiance = load_radiance(tmp_path / "field.safetensors", ns)[0]
    looking_at((0.5, 0.1, 0.2), 300).save(tmp_path / "rays.npz")
    line = [tmp_path / "rays.npz", "-o", tmp_path / "gaze.safetensors", "--field", tmp_path / "field.safetensors"]
    line += "--recipe small --semantic snapshot --steps 4 --probes 6 --radius 0.5 --min-rays 8".split()
    line += "--directions 32 --zones 0".split()
    code, said = nerg(capsys, *line, "--begin", "field", "--freeze")
    assert code == 0, said
    trained, about = load_gaze(tmp_path / "gaze.safetensors", ns)
    assert trained.config.semantic == "snapshot" and about["provenance"]["begins_as"] == "field.safetensors"
    np.testing.assert_array_equal(np.array(trained.grid.table), np.array(radiance.grid.table))
    for wrong, words in (
        (["--freeze"], "add it, or leave --freeze out"),
        (["--begin", "nerf"], 'must be "random" or "field"'),
    ):
        code, said = nerg(capsys, *line, *wrong)
        assert code == 1 and words in said
