import drjit as dr
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.maths.sphere import DEGREES, fibonacci_directions, harmonics, rotated_harmonics


@pytest.mark.parametrize("degree", DEGREES.values())
def test_they_are_those_of_drjit(degree):
    d = fibonacci_directions(50)
    theirs = dr.sh_eval(dr.llvm.Array3f(d.T.astype(np.float32)), degree)
    assert np.abs(harmonics(d, degree) - np.stack(np.broadcast_arrays(*map(np.array, theirs)), axis=1)).max() < 1e-6


def test_they_are_orthonormal():
    y = harmonics(fibonacci_directions(20_000), 3)
    assert np.abs(y.T @ y * (4 * np.pi / len(y)) - np.eye(16)).max() < 1e-3


def test_a_turned_function_is_turned():
    rng = np.random.default_rng(0)
    c, d = rng.normal(size=(5, 16, 3)), fibonacci_directions(100)
    turn = Rotation.random(random_state=rng).as_matrix()
    turned = rotated_harmonics(c, turn)
    at = lambda c, d: np.einsum("dk,nkc->ndc", harmonics(d, 3), c)
    assert np.abs(at(turned, d) - at(c, d @ turn)).max() < 1e-12
