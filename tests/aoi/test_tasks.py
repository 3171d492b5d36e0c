"""What a worker writes of a count, read again."""

from dataclasses import fields, replace

import numpy as np

from nerg_mi.aoi.options import StatisticsOptions
from nerg_mi.aoi.parts import OF_COUNTS, described, foretell_part, read_foretold, read_sums, write_sums
from nerg_mi.statistics.visits import ALL, Cell, Sums
from nerg_mi.tasks.inputs import read_input

from .place import write_place


def test_sums_come_back_one_by_one(tmp_path):
    cells = (ALL, Cell("window", "früh"))
    one = Sums.empty(("a", "b"), cells, [(cells[0], "p"), (cells[1], "p"), (cells[0], "q")])
    one.time[:] = (0.1, 1 / 3, 7)
    two = replace(one, time=one.time * 2, moves=one.moves + 1)
    write_sums(tmp_path / "s.npz", [one, two])
    found = read_sums(tmp_path / "s.npz")
    for back, sums in zip(found, (one, two), strict=True):
        for f in fields(Sums):
            assert np.array_equal(getattr(back, f.name), getattr(sums, f.name)), f.name


def test_a_setting_is_known_by_its_files_and_by_the_options_that_matter(tmp_path):
    (tmp_path / "a").write_text("1")
    given = lambda **o: described({}, StatisticsOptions(**o), OF_COUNTS, "m", (read_input("a", tmp_path / "a"),))
    before = given()
    assert given(resamples=300, seed=7) == before and given(margin=0.1)["digest"] != before["digest"]
    (tmp_path / "a").write_text("2")
    assert given()["digest"] != before["digest"]


def test_what_a_field_foretells_of_people(tmp_path, rgb):
    write_place(tmp_path)
    files = {"scene/scene.xml": tmp_path / "scene.xml", "areas/areas.json": tmp_path / "areas.json"}
    names = {"scene": "scene/scene.xml", "areas": "areas/areas.json"}
    options = {"margin": 0.03, "samples": 4, "directions": 64}
    parameters = {"files": names, "options": options, "mode": "llvm_ad_rgb", "digest": "x", "view": 120.0}
    parameters |= {"positions": [[1.0, 2, 1.6]] * 2, "ahead": [[1.0, 0, 0], [-1.0, 0, 0]]}
    foretell_part(parameters, files, tmp_path / "f.npz")
    found = read_foretold(tmp_path / "f.npz")
    assert found.share.shape == (2, 3) and np.array_equal(found.share[0], found.share[1])
    assert found.visible[0].any() and not found.visible[1].any()
