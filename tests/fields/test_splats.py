import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.fields.splats import Splats, splats_from_raw_parameters, harmonics_from_colors, logits_from_opacities, quaternions_to_matrices, multiply_quaternions
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.sphere import fibonacci_directions, eval_harmonics

RNG = np.random.default_rng(0)


def some(**changes):
    n = 6
    parts = {
        "centers": RNG.normal(size=(n, 3)),
        "scales": np.ones((n, 3)),
        "rotations": RNG.normal(size=(n, 4)),
        "opacities": np.full(n, 0.5),
        "harmonics": RNG.normal(size=(n, 4, 3)),
    }
    return Splats(**(parts | changes))


def test_what_a_training_stores_is_activated_in_float64():
    logits, logs = np.array([-40.0, 0, 3.5]), np.array([[-8.0, 0, 1]] * 3)
    splats = splats_from_raw_parameters(np.zeros((3, 3)), logs, [[2, 0, 0, 0]] * 3, logits, np.zeros((3, 1, 3)))
    assert np.allclose(splats.opacities, 1 / (1 + np.exp(-logits)), rtol=1e-7)
    assert np.allclose(splats.scales, np.exp(logs), rtol=1e-7) and splats.rotations[0, 0] == 1
    assert np.allclose(logits_from_opacities(1 / (1 + np.exp(-np.array([-9.0, 0, 5])))), [-9, 0, 5])


def test_colors_of_degree_0_are_the_same_from_everywhere():
    colors = RNG.uniform(size=(4, 3))
    seen = np.einsum("dk,nkc->ndc", eval_harmonics(fibonacci_directions(5), 0), harmonics_from_colors(colors)) + 0.5
    assert np.allclose(seen, colors[:, None])


def test_quaternions_are_rotations():
    a, b = Rotation.random(4, random_state=RNG), Rotation.random(4, random_state=RNG)
    wxyz = lambda r: r.as_quat()[:, [3, 0, 1, 2]]
    assert np.allclose(quaternions_to_matrices(wxyz(a)), a.as_matrix())
    assert np.allclose(quaternions_to_matrices(multiply_quaternions(wxyz(a), wxyz(b))), (a * b).as_matrix())


def test_a_placed_place_is_the_same_place():
    splats = some()
    turn = Rotation.random(random_state=RNG).as_matrix()
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 3 * turn, [1, 2, 3]
    placed = splats.transform(Similarity(matrix))
    assert np.allclose(placed.centers, 3 * splats.centers @ turn.T + [1, 2, 3], atol=1e-5)
    assert np.allclose(placed.axes(), turn @ splats.axes(), atol=1e-6) and np.allclose(placed.scales, 3)
    d = fibonacci_directions(20)
    at = lambda s, d: np.einsum("dk,nkc->ndc", eval_harmonics(d, 1), s.harmonics.astype(float))
    assert np.allclose(at(placed, d @ turn.T), at(splats, d), atol=1e-5)
    assert splats.transform(Similarity()) is splats and placed.degree == 1 and len(placed) == 6


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"centers": np.full((6, 3), np.nan)}, "centers.*not finite"),
        ({"rotations": np.zeros((6, 4))}, "length 0"),
        ({"opacities": np.zeros(5)}, "shape"),
        ({"harmonics": np.zeros((6, 5, 3))}, "no degree"),
    ],
)
def test_what_is_no_place_is_refused(changes, said):
    with pytest.raises(ValueError, match=said):
        some(**changes)


def test_values_are_kept_where_they_make_sense():
    splats = some(opacities=np.linspace(-1, 2, 6), scales=np.zeros((6, 3)))
    assert splats.opacities.min() == 0 and splats.opacities.max() == 1 and splats.scales.min() > 0
