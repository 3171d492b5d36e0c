"""Names of participants are removed from rays, file names and metadata; all other data remain."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.tracking.pseudonyms import pseudonymise, read_salt
from nerg_mi.tracking.rays import Rays, merge_rays
from nerg_mi.tracking.readers.columns import ColumnMap
from tests.tracking.people import some_rays
from tests.tracking.readers.examples import read

SALT = bytes(range(16))
NAMES = ("Zoe Ames", "anna", "anna2", "bo")


@pytest.fixture
def rays(tmp_path):
    """Four participants, with one file each that contains their name, and a dropped row in each."""
    for i, name in enumerate(NAMES):
        (tmp_path / f"{name}.csv").write_text(
            "t,x,y,z,a,b,c\n" + f"{i},0,0,{i},0,1,0\n{i + 0.5},0,0,{i},0,0,1\n9,,0,0,1,0,0\n"
        )
    files = [tmp_path / f"{n}.csv" for n in NAMES]
    rays_ = read("table", *files, columns=ColumnMap.parse("origin=x,y,z direction=a,b,c t=t"))
    rays_.metadata["recorded_by"] = "ANNA, of /data/Zoe Ames/raw"
    return rays_.with_step(step="filter", kept=8, of=8, persons=["anna", "bo"]).with_step(
        step="split", kept=8, of=8, by={"person": {"test": ["anna2"]}}
    )


def test_no_name_remains(rays, tmp_path):
    hidden = pseudonymise(rays)
    hidden.save(tmp_path / "out.npz")
    back = Rays.load(tmp_path / "out.npz")
    text = json.dumps([back.metadata, back.persons]).lower()
    for name in ("zoe", "ames", "anna", '"bo"', "bo.csv"):
        assert name not in text
    assert all(len(p) == 17 and p.startswith("p") for p in back.persons) and len(set(back.persons)) == 4
    assert "salt, not kept" in back.metadata["pseudonyms"]
    # Suffixes identify the file types, and each dropped row still belongs to one of them.
    sources = [s["file"] for s in back.metadata["sources"]]
    assert all(s.endswith(".csv") for s in sources) and sources == sorted(sources)
    assert {d["file"] for d in back.metadata["dropped"]} == set(sources)
    for digest in (s["sha256"] for s in rays.metadata["sources"]):
        assert digest not in text
    step, split = back.metadata["steps"]
    assert step["step"] == "filter" and set(step["persons"]) <= set(back.persons)
    assert split["by"]["person"]["test"][0] in back.persons


def test_rays_keep_their_participants(rays):
    hidden = pseudonymise(rays, SALT)
    assert list(hidden.persons) == sorted(hidden.persons) and (np.diff(hidden.person) >= 0).all()
    # Each participant is at a height of their own.
    by_name = {rays.origin[rays.person == p, 2][0]: np.sort(rays.t[rays.person == p]) for p in range(4)}
    for p in range(4):
        mine = hidden.person == p
        assert len(set(hidden.origin[mine, 2])) == 1
        assert np.array_equal(hidden.t[mine], by_name[hidden.origin[mine, 2][0]])
    assert hidden.metadata["rows_read"] == rays.metadata["rows_read"]
    assert hidden.metadata["transform"] == rays.metadata["transform"]


def test_pseudonyms_depend_on_the_salt(rays):
    one, again, other = pseudonymise(rays, SALT), pseudonymise(rays, SALT), pseudonymise(rays, SALT[::-1])
    assert one.persons == again.persons and not set(one.persons) & set(other.persons)
    assert one.metadata["sources"] == again.metadata["sources"]
    assert not set(pseudonymise(rays).persons) & set(pseudonymise(rays).persons)
    # The same participant in another import, among others.
    some = pseudonymise(rays.select(rays.person == 2), SALT)
    at = dict(zip(one.origin[:, 2], one.person))
    assert some.persons[some.person[0]] == one.persons[at[some.origin[0, 2]]]


def one_ray(name, note):
    rays = Rays([0.0], [0], (name,), np.zeros((1, 3)), [[1.0, 0, 0]], [1.0])
    return replace(rays, metadata={**rays.metadata, "note": note})


def test_kinds_of_tracking_belong_to_pseudonyms():
    mixed = merge_rays([one_ray("eye", "").with_tracking("eye"), one_ray("Ada", "").with_tracking("head")])
    mixed.metadata["tracking_by_person"]["Bob"] = "eye"  # without rays
    hidden = pseudonymise(mixed, SALT)
    assert sorted(hidden[k].tracking for k in range(2)) == ["eye", "head"]
    assert hidden.metadata["tracking_by_person"].keys() == set(hidden.persons)


def test_short_names_are_not_replaced_within_words():
    """A person called "a" does not change the words of the metadata."""
    rays = one_ray("a", "a draft")
    hidden = pseudonymise(rays, SALT)
    assert hidden.metadata["note"] == "a draft" and hidden.metadata["frame"] == rays.metadata["frame"]


def test_letters_of_other_alphabets():
    hidden = pseudonymise(one_ray("Straße", "STRAßE and \u017ftra\u00dfe"), SALT)
    assert "stra" not in json.dumps(hidden.metadata, ensure_ascii=False).lower()


def test_salts(tmp_path):
    (tmp_path / "salt").write_bytes(SALT)
    assert read_salt(tmp_path / "salt") == SALT
    (tmp_path / "short").write_bytes(b"secret")
    with pytest.raises(NergError, match="short.* 6 bytes.*urandom"):
        read_salt(tmp_path / "short")
    with pytest.raises(NergError, match="absent"):
        read_salt(tmp_path / "absent")
    with pytest.raises(NergError, match="at least 16"):
        pseudonymise(one_ray("a", ""), b"x")


def test_participants_called_as_what_was_tracked():
    rays = some_rays(4, person=[0, 1, 0, 1], persons=("eye", "head")).with_tracking("head")
    hidden = pseudonymise(rays, bytes(range(32)))
    assert hidden.tracking == "head" and not {"eye", "head"} & set(hidden.persons)
