"""ARETT on HoloLens 2."""

import numpy as np

from tests.rays.readers.headset_examples import arett
from tests.rays.readers.reading import dropped, read


def test_rays_of_unity_with_their_hits(tmp_path):
    rng = np.random.default_rng(0)
    origin, direction = rng.normal(size=(5, 3)), rng.normal(size=(5, 3))
    hit = origin + 3 * direction
    hit[2] = np.nan
    path = tmp_path / "p03.csv"
    path.write_text(arett(origin, direction, hit, [1 == 1, False, True, True, True], [True] * 4 + [False]))
    rays = read("arett", path)
    kept, unity = [0, 2, 3], [0, 2, 1]  # z of Unity is y of rays
    d = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    assert np.allclose(rays.origin, origin[kept][:, unity]) and np.allclose(rays.direction, d[kept][:, unity])
    assert np.allclose(rays.hit, hit[kept][:, unity], equal_nan=True) and rays.persons == ("p03",)
    assert np.allclose(rays.t, 1.7e9 + 0.033 * np.array(kept), atol=1e-6)
    assert dropped(rays) == {"gazeHasValue is not true": [[3, 3]], "isCalibrationValid is not true": [[6, 6]]}
