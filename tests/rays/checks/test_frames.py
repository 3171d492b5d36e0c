from dataclasses import replace

import numpy as np
import pytest

from tests.rays.checks.people import warnings_of, watch

BO, TWO = slice(3000, 6000), slice(3000, 9000)


def moved(rays, rows, matrix=((1, 0, 0), (0, 1, 0), (0, 0, 1)), shift=(0, 0, 0)):
    """Some of the people in another frame."""
    new = {name: getattr(rays, name).copy() for name in ("origin", "direction", "hit", "head")}
    for name, column in new.items():
        column[rows] = column[rows] @ np.asarray(matrix, float).T + (shift if name in ("origin", "hit") else 0)
    return replace(rays, **new)


@pytest.mark.parametrize("down, warned", [(1.6, True), (1.0, True), (-0.8, True), (0.3, False), (-0.2, False)])
def test_another_floor(down, warned):
    said = warnings_of(moved(watch(5), BO, shift=(0, 0, -down)))
    assert ("the heads of bo are" in said and "nerg align" in said) == warned and bool(said) == warned


def test_another_unit():
    rays = watch(5)
    for factor, unit in ((100, "cm"), (1000, "mm")):
        new = rays.origin.copy()
        new[BO] *= factor
        said = warnings_of(replace(rays, origin=new, hit=None))
        assert "the heads of bo are" in said and f"is their unit {unit}? Import them apart (--units {unit})" in said


def test_heights_say_nothing_where_the_floor_is_not_known():
    rays = moved(watch(5), BO, shift=(0, 0, -1.6))
    assert warnings_of(replace(rays, metadata={**rays.metadata, "floor": "unknown"})) == ""


def test_far_away():
    said = warnings_of(moved(watch(5), BO, shift=(0, 60, 0)))
    assert "bo is 5" in said and "m and more from where all others are" in said
    # A walk from shop to shop: each is near another.
    chain = watch(4)
    new = chain.origin + np.repeat(np.arange(4), 3000)[:, None] * (9, 0, 0)
    assert warnings_of(replace(chain, origin=new, hit=None)) == ""


@pytest.mark.parametrize(
    "matrix, what",
    [
        ([[0, -1, 0], [1, 0, 0], [0, 0, 1]], "a turn by -90 degrees"),
        ([[-1, 0, 0], [0, 1, 0], [0, 0, 1]], "x negated"),
        ([[-1, 0, 0], [0, -1, 0], [0, 0, 1]], "x and y negated"),
    ],
)
@pytest.mark.parametrize("rows", [BO, TWO])
def test_turned_or_mirrored(matrix, what, rows):
    said = warnings_of(moved(watch(5), rows, matrix))
    assert "walks where no other does" in said and f"with {what} (of rays)" in said
    # In a room about the origin a turn leaves everybody in the room.
    assert warnings_of(moved(moved(watch(5), slice(None), shift=(-4, -3, 0)), BO, np.diag([-1, -1, 1]))) == ""


def test_recordings_of_one_person_are_told_by_their_times():
    rays = watch(2)
    again = moved(rays, slice(1500, 3000), shift=(0, 0, -1.6))
    t = again.t + np.where(np.arange(6000) // 1500 == 1, 500.0, 0.0)
    assert "the heads of ann (from 530 s) are at a height of -0.1" in warnings_of(replace(again, t=t))
