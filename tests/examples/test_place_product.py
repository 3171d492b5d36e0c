"""Placing a product, at a size that takes seconds: what is found, not what is printed."""

import numpy as np
import pytest

from examples import place_product


@pytest.fixture(scope="module")
def shelf_run(tmp_path_factory):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    out = tmp_path_factory.mktemp("applications") / "shelf.png"
    return place_product.main(["--quick", "--out", str(out)]), out


@pytest.mark.nightly
def test01_the_box_climbs_to_where_the_sweep_says(shelf_run):
    found, out = shelf_run
    at, values = found["sweep"]
    assert out.stat().st_size > 10_000 and values.min() > 0 and values.max() > 2 * values.min()
    for start, end, before, after, optimum, share in found["rows"]:
        assert after > before and abs(end - optimum) < 0.1 and share > 0.97, (start, end, optimum, share)


@pytest.mark.nightly
def test02_derivatives_without_edges_are_those_of_the_sweep(shelf_run):
    checks = shelf_run[0]["checks"]
    automatic, central = checks[:, 3], checks[:, 4]
    assert np.allclose(automatic, central, rtol=0.05, atol=0.05 * np.abs(central).max())
    assert np.all((checks[:, 5] >= 0) & (checks[:, 5] < 0.05))


def test03_uphill():
    values = np.array([0, 1, 3, 2, 2.5, 4, 1, 0.0])
    assert place_product.uphill(values, 0, 1) == 2 and place_product.uphill(values, 0, 3) == 5
    assert place_product.uphill(values, 7, 2) == 5 and place_product.uphill(values, 5, 1) == 5


def test04_an_unknown_shelf_is_named(rgb):
    with pytest.raises(SystemExit, match='no shelf "attic".*wall_cosmetics'):
        place_product.Shelf("attic")
