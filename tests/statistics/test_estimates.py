"""p-values of many hypotheses, adjusted for the false discovery rate."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.statistics.estimates import adjusted


@pytest.mark.parametrize(
    "p, expected",
    [
        # 5 hypotheses: 0.001·5/1, 0.008·5/2, then 0.04·5/4 for 0.03 as well, since 0.03·5/3 is not less.
        ([0.001, np.nan, 0.04, 0.03, 0.2, 0.008], [0.005, np.nan, 0.05, 0.05, 0.2, 0.02]),
        ([0.9, 0.95], [0.95, 0.95]),
        ([np.nan, 0.3], [np.nan, 0.3]),
        ([np.nan] * 3, [np.nan] * 3),
        ([], []),
    ],
)
def test_hypotheses_without_a_p_value_do_not_count(p, expected):
    assert np.allclose(adjusted(np.array(p)), expected, rtol=1e-12, equal_nan=True)
