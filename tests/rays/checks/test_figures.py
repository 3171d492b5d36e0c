import numpy as np
import pytest

from nerg_mi.rays.checks import group_medians, name_some


@pytest.mark.parametrize("seed", range(3))
def test_medians_of_groups(seed):
    rng = np.random.default_rng(seed)
    values, group = rng.normal(size=97), rng.integers(0, 7, 97) * 2
    found = group_medians(values, group, 15)
    for g in range(15):
        mine = values[group == g]
        assert found[g] == np.median(mine) if mine.size else np.isnan(found[g])
    assert np.isnan(group_medians(np.empty(0), np.empty(0, int), 3)).all()


def test_names():
    assert (
        name_some(["ann"]) == "ann"
        and name_some(list("abc")) == "a, b, c"
        and name_some(list("abcd")) == "a, b, c and 1 more"
    )
