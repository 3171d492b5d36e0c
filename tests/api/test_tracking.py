"""Tracking files in, rays out."""

import numpy as np
import pytest

import nerg_mi as nerg

COLUMNS = "origin=x,y,z direction=dx,dy,dz t=t person=who"


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "day.csv"
    path.write_text("t,who,x,y,z,dx,dy,dz\n0,Ada,100,200,160,1,0,0\n1,Bob,100,200,160,0,0,1\n")
    return path


def test01_options_are_the_readers(table):
    rays = nerg.import_rays(table, columns=COLUMNS, units="cm")
    assert np.allclose(rays.origin, [(1, 2, 1.6)] * 2) and rays.persons == ("Ada", "Bob")


def test02_options_of_the_import(table, tmp_path):
    out = tmp_path / "rays.npz"
    rays = nerg.import_rays([table], columns=COLUMNS, output=out, pseudonyms=True)
    assert not {"Ada", "Bob"} & set(rays.persons)
    assert nerg.load_rays(out).persons == rays.persons


def test03_wrong_options_are_told(table):
    with pytest.raises(nerg.NergError, match="colums"):
        nerg.import_rays(table, colums=COLUMNS)
    with pytest.raises(nerg.NergError, match='"nope"'):
        nerg.import_rays(table, "nope")


def test04_progress_is_told(table):
    told = []

    class Reporter:
        def message(self, text): ...
        def warn(self, text): ...
        def progress(self, share, text=""):
            told.append(text)

    nerg.import_rays(table, columns=COLUMNS, reporter=Reporter())
    assert any("day.csv" in text for text in told)
