"""The task to begin with, against the closed form."""

import json
import math

import pytest

from nerg_mi.tasks.example import integrate


@pytest.mark.parametrize("k", range(3))
def test_slices_are_differences_of_the_cosine(tmp_path, k):
    found = integrate({"slice": k, "of": 3}, {}, tmp_path / "a.json")
    exact = math.cos(math.pi * k / 3) - math.cos(math.pi * (k + 1) / 3)
    assert found["integral"] == pytest.approx(exact, abs=1e-11)
    assert json.loads((tmp_path / "a.json").read_text()) == found
