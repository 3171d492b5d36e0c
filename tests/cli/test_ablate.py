"""`nerg ablate`: what it hands on."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest

from nerg_mi.cli import main
from nerg_mi.workflows import ablation  # noqa: F401 (declares the command)
from nerg_mi.workflows.ablation import AblationOptions

from .handed import keep_handed

ASKED = {
    "field": "place.safetensors",
    "scene": "room.xml",
    "geometry": "none",
    "recipes": "small,paper",
    "seeds": 2,
    "steps": 5,
    "default_steps": 6,
    "probes": 7,
    "zones": 4,
    "positions": 8,
    "people": 0.25,
    "radius": 0.5,
    "first": 4,
    "kappa": 9.0,
    "min_rays": 3,
    "law": "a:B",
    "cameras": 1,
    "size": "16x9",
    "store": "kept",
    "scheduler": "local:2",
    "threads": 2,
    "mode": "llvm_ad_mono",
}


def test_the_job_is_given_what_was_asked_for(monkeypatch):
    given = keep_handed(monkeypatch, "ablate")
    line = [str(word) for name, value in ASKED.items() for word in ("--" + name.replace("_", "-"), value)]
    for more in ([*line, "--variant", "emit", "--variant", "begins as the field", "--no-refit"], []):
        with pytest.raises(SystemExit) as end:
            main(["ablate", "rays.npz", "-o", "out", *more])
        assert not end.value.code
    asked = {k: Path(v) if k in ("field", "scene", "store") else v for k, v in ASKED.items()}
    options = AblationOptions(**asked, variant=("emit", "begins as the field"), refit=False)
    files = {"rays": Path("rays.npz"), "output": Path("out")}
    assert given == [{**files, "options": options}, {**files, "options": AblationOptions()}]
    assert {*ASKED, "variant", "refit"} == {f.name for f in fields(AblationOptions)}
