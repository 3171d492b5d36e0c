"""Which of many differences are found."""

from __future__ import annotations

import numpy as np
from scipy import stats

from nerg_mi.statistics.estimates import adjusted, discoveries


def test01_discoveries():
    p = np.array([0.001, np.nan, 0.04, 0.03, 0.2, 0.008])
    assert np.allclose(adjusted(p)[[0, 2, 3, 4, 5]], stats.false_discovery_control(p[[0, 2, 3, 4, 5]]))
    assert np.isnan(adjusted(p)[1]) and not discoveries(p)[1]
    assert discoveries(p).tolist() == (adjusted(p) <= 0.05).tolist()
    assert adjusted(np.full(3, np.nan)).shape == (3,) and len(adjusted(np.zeros(0))) == 0
