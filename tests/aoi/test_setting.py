"""What a count needs besides rays."""

import numpy as np
import pytest

from nerg_mi.aoi.options import StatisticsOptions
from nerg_mi.aoi.predicted import setting_of
from nerg_mi.errors import NergError
from nerg_mi.fields.mlp import namespace
from nerg_mi.formats.areas import read_areas

from .place import write_place


def setting(folder, scene=True, **options):
    asked = StatisticsOptions(areas=folder / "areas.json", **options)
    place = folder / "scene.xml" if scene else None
    return setting_of(place, None, None, read_areas(folder / "areas.json"), asked, namespace("llvm_ad_rgb"))


def test_cohorts_are_those_of_the_table_or_of_the_rays(tmp_path, rgb):
    write_place(tmp_path)
    (tmp_path / "who.csv").write_text("person,cohort\na,old\nb,new\n")
    found = setting(tmp_path)
    assert found.members == [(0,), (1,), (0, 1)] and found.margin == 0.03
    assert found.counting(False, ("x",)).cohort_names == ("x",) and found.counting(True, ()).hits
    table = setting(tmp_path, cohorts=tmp_path / "who.csv").counting(False, ("x",))
    assert table.cohort_names == ("new", "old") and list(table.movable) == [0, 1]


def test_where_no_place_is_known_things_hide_each_other(tmp_path, rgb):
    write_place(tmp_path)
    areas = (
        (tmp_path / "areas.json").read_text().replace('"shape": "stand"', '"min": [2.5, 1, 0], "max": [2.9, 2, 2.2]')
    )
    (tmp_path / "areas.json").write_text(areas)
    found = setting(tmp_path, scene=False, seen=True)
    depth = found._depth_or_things(np.array([[0.0, 1.6, 1.5], [0, 2.4, 1.5]]), np.array([[1.0, 0, 0]] * 2))
    assert np.allclose(depth, (2.5, 4.0))


def test_what_is_plainly_wrong_is_told_before_anything_is_loaded(tmp_path, rgb):
    write_place(tmp_path)
    with pytest.raises(NergError, match="--window is NAME=FROM,TO"):
        setting(tmp_path, windows=("late",))
