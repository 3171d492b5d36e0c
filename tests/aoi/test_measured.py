"""Tests of `nerg_mi.aoi.measured`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.aoi.areas import AreaGroup, Areas
from nerg_mi.aoi.measured import (
    AoiContext,
    Counting,
    TimeWindow,
    count_block,
    facing_directions,
    iter_blocks,
    read_cohorts,
)
from nerg_mi.aoi.placed import open_placed_areas
from nerg_mi.aoi.predicted import ViewpointSampler
from nerg_mi.aoi.settings import AoiSampling, VisitRules
from nerg_mi.aoi.visits import ALL, Cell, merge_sums
from nerg_mi.errors import NergError
from nerg_mi.files.tables import write_csv
from nerg_mi.formats.boxes import Region
from nerg_mi.tracking.rays import Rays

from .place import SIGN, STAND, people

# ---- Cohorts ----


def test_cohorts_are_read(tmp_path):
    (tmp_path / "c.csv").write_text("cohort;person\nold;Ada\nyoung;Bo\nold;Ada\n")
    assert read_cohorts(tmp_path / "c.csv") == {"Ada": "old", "Bo": "young"}


def test_cohorts_of_participants_and_remedies_of_their_table(tmp_path):
    (tmp_path / "c.csv").write_text("Participant,Cohort\nAda,old\n")
    assert read_cohorts(tmp_path / "c.csv") == {"Ada": "old"}
    (tmp_path / "c.csv").write_text("person,kind\nAda,old\n")
    with pytest.raises(NergError, match="no column cohort; .*person, kind") as error:
        read_cohorts(tmp_path / "c.csv")
    assert "columns" not in error.value.parameters
    (tmp_path / "c.csv").write_text("person,cohort\nAda,old,x\n")
    with pytest.raises(NergError, match="line 2: 3 cells") as error:
        read_cohorts(tmp_path / "c.csv")
    assert "skip_bad_lines" not in error.value.parameters


def test_cohort_names_survive_a_round_trip(tmp_path):
    cohorts = {"=Ada": "-old", "@Bo": "+young", "'Cy": "old", "'=Di": "-1"}
    write_csv(tmp_path / "c.csv", [{"person": k, "cohort": v} for k, v in cohorts.items()])
    assert read_cohorts(tmp_path / "c.csv") == cohorts


def test_rows_without_a_cohort_are_in_none(tmp_path):
    (tmp_path / "c.csv").write_text("sep=;\nperson;cohort\nAda;old\nBo;\n;young\n;\n")
    assert read_cohorts(tmp_path / "c.csv") == {"Ada": "old"}
    (tmp_path / "c.csv").write_text("person,cohort\nBo,\n")
    with pytest.raises(NergError, match="no participants"):
        read_cohorts(tmp_path / "c.csv")


def test_cohorts_of_ids_and_names_in_another_form(tmp_path):
    (tmp_path / "c.csv").write_text("person,cohort\n1.0,o\u0308ld\nJo\u0308rg,young\n", "utf-8")
    assert read_cohorts(tmp_path / "c.csv") == {"1": "\u00f6ld", "J\u00f6rg": "young"}


@pytest.mark.parametrize(
    "text", ["person,cohort\n", "person,group\nAda,old\n", "person,cohort\nAda,old\nAda,young\n", ""]
)
def test_invalid_cohorts_are_refused(tmp_path, text):
    (tmp_path / "c.csv").write_text(text)
    with pytest.raises(NergError, match=r"c\.csv"):
        read_cohorts(tmp_path / "c.csv")


# ---- Blocks and hits ----

RULES = VisitRules()


AREAS = (Region.create("sign", *SIGN), Region.create("stand", *STAND), AreaGroup("both", ("sign", "stand")))


def counting(*areas, align=None, tolerance=0.0, cohorts=(), **changes):
    sampling = AoiSampling(margin=0.0, tolerance=tolerance)
    placed = open_placed_areas(None, None, Areas(areas or AREAS), align, sampling)
    return AoiContext(placed, Counting(**changes), False, cohorts)


def test_blocks_contain_whole_sessions_and_all_samples():
    rays = people(7, 60)
    # Two sessions per participant, separated by a pause of two minutes.
    rays = replace(rays, t=rays.t + 120.0 * (rays.t >= 6))
    in_order = rays.select(np.lexsort((rays.t, rays.person)))
    whole_result = merge_sums([count_block(in_order, counting())])
    for max_count in (1, 50, 100, 10_000):
        blocks = list(iter_blocks(rays, RULES, max_count))
        assert sum(len(b) for b in blocks) == len(rays)
        if max_count == 1:
            assert [len(b) for b in blocks] == [30] * 14
        for b in blocks:
            assert not (np.diff(b.person) < 0).any()
        result = merge_sums(count_block(b, counting()) for b in blocks)
        for name in ("time", "dwell_time", "visits", "first_visit_sum", "transitions", "first_visit_count"):
            assert np.allclose(getattr(result, name), getattr(whole_result, name)), name


def test_session_across_dataset_parts_is_one_session(tmp_path):
    pytest.importorskip("pyarrow")
    import nerg_mi as nerg
    from nerg_mi.tracking import dataset, dataset_write

    rays = people(3, 80, cohorts=False)
    lines = ["t,p,x,y,z,a,b,c"]
    for k in range(len(rays)):
        numbers = [*rays.origin[k].astype(np.float32).tolist(), *rays.direction[k].tolist()]
        lines.append(",".join([repr(float(rays.t[k])), rays.persons[rays.person[k]], *map(repr, numbers)]))
    (tmp_path / "day.csv").write_text("\n".join(lines))
    columns = "origin=x,y,z direction=a,b,c t=t person=p"
    result = {}
    for rows in (50, dataset_write.PART_ROWS):
        before = dataset_write.PART_ROWS
        dataset_write.PART_ROWS = rows
        try:
            name = tmp_path / f"{rows}.rays"
            nerg.import_rays(tmp_path / "day.csv", columns=columns, output=name)
        finally:
            dataset_write.PART_ROWS = before
        result[rows] = merge_sums(count_block(b, counting()) for b in iter_blocks(dataset.RayDataset.open(name), RULES))
        if rows == 50:
            assert len(dataset.RayDataset.open(name).parts) > 4 and dataset and dataset
    a, b = result.values()
    for name in ("time", "dwell_time", "visits", "first_visit_sum", "first_visit_count"):
        order = [a.rows.index(row) for row in b.rows]
        assert np.allclose(getattr(a, name)[order], getattr(b, name)), name


def test_missing_samples_are_refused():
    with pytest.raises(NergError, match="no gaze samples"):
        list(iter_blocks(people().select(np.zeros(0, int)), RULES))


def test_angular_tolerance_counts_near_misses():
    o = np.tile([1.0, 3.0, 1.5], (3, 1))
    # The nearest edge of the sign is at y = 2.5, x = 4.2.
    edge = np.arctan2(-0.5, 3.2)
    angles = edge + np.radians([0.5, 1.9, 2.5])
    d = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(3)])
    rays = Rays(np.arange(3.0), np.zeros(3, int), ("a",), o, d, np.ones(3))
    assert [len(rows) for rows in counting().assign_hits(rays).rows] == [0, 0, 0]
    assert counting(tolerance=2.0).assign_hits(rays).rows[0].tolist() == [0, 1]


def test_samples_in_another_frame():
    align = np.diag([2.0, 2, 2, 1])
    align[:3, 3] = 1, 2, 3
    moved = [Region.create(n, *(2 * c + (1, 2, 3))) for n, c in (("sign", SIGN), ("stand", STAND))]
    rays = people()
    one, two = counting().assign_hits(rays), counting(*moved, AREAS[2], align=align).assign_hits(rays)
    for a, b in zip(one.rows, two.rows):
        assert a.tolist() == b.tolist()
    for a, b in zip(one.distance, two.distance):
        # In metres.
        assert np.allclose(a, b)


def test_cell_masks():
    rays = people()
    made = counting(
        windows=(TimeWindow("w", 1.0, 2.0),), zones=(Region.create("z", [0, 0, 9], [1, 4, 9.1]),), cohorts=("even", "x")
    )
    cells = dict(made.cell_masks(rays, rays.origin))
    assert cells[ALL] is None and not cells[Cell("cohort", "x")].any()
    assert np.array_equal(cells[Cell("cohort", "even")], rays.person % 2 == 0)
    assert np.array_equal(cells[Cell("window", "w")], (rays.t >= 1) & (rays.t < 2))
    # Zones ignore the height.
    assert np.array_equal(cells[Cell("zone", "z")], rays.origin[:, 0] <= 1)


def test_cohorts_come_from_the_table_or_the_samples(tmp_path):
    (tmp_path / "who.csv").write_text("person,cohort\nname 1,old\nname 2,new\n")
    rays, context = people(), counting(cohorts=("odd",))
    assert [cell.value for cell, _ in context.cell_masks(rays, rays.origin)] == ["", "odd"]
    cells = dict(replace(context, counting=Counting(cohorts=tmp_path / "who.csv")).cell_masks(rays, rays.origin))
    assert [cell.value for cell in cells] == ["", "new", "old"]
    assert np.array_equal(cells[Cell("cohort", "old")], rays.person == 1)


def test_transitions_lead_between_elementary_areas():
    assert counting().transition_areas == [0, 1]


def test_facing_directions_are_head_directions():
    rays = people(2, 3)
    head = np.tile(np.array([0, 1, 0], np.float32), (6, 1))
    head[0] = np.nan
    result = facing_directions(replace(rays, head=head))
    assert np.array_equal(result[0], rays.direction[0]) and np.allclose(result[1:], [0, 1, 0])
    assert facing_directions(rays) is rays.direction


def test_viewpoints_cover_all_participants():
    picker = ViewpointSampler(100)
    for block in iter_blocks(people(5, 80), RULES, 100):
        picker.add(block, counting())
    observers = picker.viewpoints()
    assert set(observers.participants) == {f"name {k}" for k in range(5)} and 5 <= len(observers.participants) <= 10
    assert all(ALL in cells for cells in observers.cells) and observers.positions.shape == observers.facing.shape
