"""Rays in blocks that hold sittings as a whole, and what they are on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.aoi.measured import Counting, EyePicker, Window, ahead, blocks_of, count_block
from nerg_mi.aoi.scene import Surroundings
from nerg_mi.errors import NergError
from nerg_mi.formats.areas import Region
from nerg_mi.maths.geometry import Similarity
from nerg_mi.rays.rays import Rays
from nerg_mi.statistics.visits import ALL, Box, Cell, LookRules, merge

from .place import SIGN, STAND, people

RULES = LookRules()


def counting(**changes):
    things = [Box(Region.of("sign", *SIGN)), Box(Region.of("stand", *STAND))]
    around = Surroundings(None, None, Similarity())
    made = Counting(around, things, ("sign", "stand", "both"), [(0,), (1,), (0, 1)], (0, 1), RULES, 0.0)
    return replace(made, **changes)


def test01_blocks_hold_sittings_as_a_whole_and_all_of_the_rays():
    rays = people(7, 60)
    # Two sittings each: a pause of two minutes in the middle.
    rays = replace(rays, t=rays.t + 120.0 * (rays.t >= 6))
    whole = merge([count_block(rays, counting())])
    for most in (1, 50, 100, 10_000):
        blocks = list(blocks_of(rays, RULES, most))
        assert sum(len(b) for b in blocks) == len(rays)
        if most == 1:
            assert [len(b) for b in blocks] == [30] * 14
        for b in blocks:
            assert not (np.diff(b.person) < 0).any()
        found = merge(count_block(b, counting()) for b in blocks)
        for name in ("time", "on_time", "looks", "first_sum", "moves", "sittings"):
            assert np.allclose(getattr(found, name), getattr(whole, name)), name


def test02_a_sitting_that_runs_over_two_parts_of_a_dataset_is_one(tmp_path):
    pytest.importorskip("pyarrow")
    import nerg_mi as nerg
    from nerg_mi.rays import dataset, dataset_write

    rays = people(3, 80, cohorts=False)
    lines = ["t,p,x,y,z,a,b,c"]
    for k in range(len(rays)):
        numbers = [*rays.origin[k].astype(np.float32).tolist(), *rays.direction[k].tolist()]
        lines.append(",".join([repr(float(rays.t[k])), rays.persons[rays.person[k]], *map(repr, numbers)]))
    (tmp_path / "day.csv").write_text("\n".join(lines))
    columns = "origin=x,y,z direction=a,b,c t=t person=p"
    found = {}
    for rows in (50, dataset_write.PART_ROWS):
        before = dataset_write.PART_ROWS
        dataset_write.PART_ROWS = rows
        try:
            name = tmp_path / f"{rows}.rays"
            nerg.import_rays(tmp_path / "day.csv", columns=columns, output=name)
        finally:
            dataset_write.PART_ROWS = before
        found[rows] = merge(count_block(b, counting()) for b in blocks_of(name, RULES))
        if rows == 50:
            assert len(dataset.RayDataset.open(name).parts) > 4 and dataset and dataset
    a, b = found.values()
    for name in ("time", "on_time", "looks", "first_sum", "sittings"):
        order = [a.rows.index(row) for row in b.rows]
        assert np.allclose(getattr(a, name)[order], getattr(b, name)), name
    assert a.sittings.sum() == 3


def test03_no_rays():
    with pytest.raises(NergError, match="no rays to count"):
        list(blocks_of(people().select(np.zeros(0, int)), RULES))


def test04_a_tolerance_lets_rays_pass_by():
    o = np.tile([1.0, 3.0, 1.5], (3, 1))
    # The sign's nearest edge, seen from there, lies at y = 2.5, x = 4.2.
    edge = np.arctan2(-0.5, 3.2)
    angles = edge + np.radians([0.5, 1.9, 2.5])
    d = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(3)])
    rays = Rays(np.arange(3.0), np.zeros(3, int), ("a",), o, d, np.ones(3))
    assert [len(rows) for rows in counting().land(rays).rows] == [0, 0, 0]
    assert counting(tolerance=2.0).land(rays).rows[0].tolist() == [0, 1]


def test05_rays_in_another_frame():
    align = np.diag([2.0, 2, 2, 1])
    align[:3, 3] = 1, 2, 3
    around = Surroundings(None, None, Similarity(align))
    moved = [Box(Region.of(n, *(2 * c + (1, 2, 3)))) for n, c in (("sign", SIGN), ("stand", STAND))]
    rays = people()
    one, two = counting().land(rays), counting(around=around, things=moved).land(rays)
    for a, b in zip(one.rows, two.rows):
        assert a.tolist() == b.tolist()
    for a, b in zip(one.distance, two.distance):
        # In metres.
        assert np.allclose(a, b)


def test06_cells():
    rays = people()
    made = counting(
        windows=[Window("w", 1.0, 2.0)], zones=[Region.of("z", [0, 0, 9], [1, 4, 9.1])], cohort_names=("even", "x")
    )
    cells = dict(made.cells(rays, rays.origin))
    assert cells[ALL] is None and not cells[Cell("cohort", "x")].any()
    assert np.array_equal(cells[Cell("cohort", "even")], rays.person % 2 == 0)
    assert np.array_equal(cells[Cell("window", "w")], (rays.t >= 1) & (rays.t < 2))
    # Of a zone only the floor counts.
    assert np.array_equal(cells[Cell("zone", "z")], rays.origin[:, 0] <= 1)


def test07_heads_tell_where_people_are_turned():
    rays = people(2, 3)
    head = np.tile(np.array([0, 1, 0], np.float32), (6, 1))
    head[0] = np.nan
    found = ahead(replace(rays, head=head))
    assert np.array_equal(found[0], rays.direction[0]) and np.allclose(found[1:], [0, 1, 0])
    assert ahead(rays) is rays.direction


def test08_eyes_are_taken_evenly_and_of_everybody():
    picker = EyePicker(100)
    for block in blocks_of(people(5, 80), RULES, 100):
        picker.take(block, counting())
    eyes = picker.eyes()
    assert set(eyes.person) == {f"name {k}" for k in range(5)} and 5 <= len(eyes.person) <= 10
    assert all(ALL in cells for cells in eyes.cells) and eyes.positions.shape == eyes.ahead.shape
