"""What pictures say of where they come from: inputs, seed, settings, versions, and nothing of the machine."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import drjit
import mitsuba
import pytest

import nerg_mi
from nerg_mi.errors import NergError
from nerg_mi.figures.style import files_among, provenance
from nerg_mi.workflows.bake_options import BakeOptions
from nerg_mi.workflows.options import PictureOptions


def test_everything_is_said(tmp_path):
    (tmp_path / "scene.xml").write_text("<scene/>")
    about = provenance("nerg render", [tmp_path / "scene.xml"], 7, {"spp": 4})
    found = json.loads(about.text()["Comment"])
    assert found["inputs"] == {"scene.xml": hashlib.sha256(b"<scene/>").hexdigest()}
    assert (found["what"], found["seed"], found["settings"]) == ("nerg render", 7, {"spp": 4})
    assert found["versions"] == {
        "nerg_mi": nerg_mi.__version__,
        "mitsuba": mitsuba.__version__,
        "drjit": drjit.__version__,
    }
    assert about.text()["Software"] == ", ".join(f"{k} {found['versions'][k]}" for k in ("nerg_mi", "mitsuba", "drjit"))


def test_who_made_it_and_where_it_is_kept_is_not_said(tmp_path):
    options = BakeOptions(store=tmp_path, scheduler="local:2", detail=0.5, seed=4)
    assert dict(provenance("x", [], 4, options).settings) == {"detail": 0.5}


def test_no_path_of_the_machine(tmp_path):
    (tmp_path / "a.csv").write_text("x")
    options = PictureOptions(
        frames=tmp_path / "a.csv",
        defaults={"field": f"{tmp_path}/deep/f.safetensors", "w": r"C:\Users\me\b.ply"},
        spp=2,
    )
    text = json.dumps(provenance("x", [tmp_path / "a.csv"], 0, options).text())
    assert str(tmp_path) not in text and "Users" not in text and str(Path.home()) not in text
    settings = provenance("x", [], 0, options).settings
    assert settings == {"frames": "a.csv", "defaults": {"field": "f.safetensors", "w": "b.ply"}, "spp": 2}


def test_files_of_one_name_and_of_one_path(tmp_path):
    for k in "ab":
        (tmp_path / k).mkdir()
        (tmp_path / k / "day.csv").write_text(k)
    paths = [tmp_path / "a/day.csv", tmp_path / "b/day.csv", tmp_path / "a/day.csv"]
    known = {paths[1]: "seen before"}
    found = provenance("x", paths, known=known).inputs
    assert found == {"day.csv": hashlib.sha256(b"a").hexdigest(), "day.csv (2)": "seen before"}
    assert known[paths[0]] == found["day.csv"]


def test_one_that_is_not_there(tmp_path):
    with pytest.raises(NergError, match="gone.xml"):
        provenance("x", [tmp_path / "gone.xml"])


def test_files_among_other_things(tmp_path):
    (tmp_path / "a.csv").write_text("x")
    assert files_among(tmp_path / "a.csv", str(tmp_path / "a.csv"), None, 3, tmp_path / "gone") == [
        tmp_path / "a.csv",
        tmp_path / "a.csv",
    ]
    # What has no name is told by its kind alone.
    assert provenance("x", settings={"rays": object()}).settings == {"rays": "object"}
