import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.fields.splats import (
    Splats,
    harmonics_from_colors,
    logits_from_opacities,
    multiply_quaternions,
    quaternions_to_matrices,
    splats_from_raw_parameters,
)
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.sphere import eval_harmonics, fibonacci_directions

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


def test_raw_parameters_are_activated_in_float64():
    logits, logs = np.array([-40.0, 0, 3.5]), np.array([[-8.0, 0, 1]] * 3)
    splats = splats_from_raw_parameters(np.zeros((3, 3)), logs, [[2, 0, 0, 0]] * 3, logits, np.zeros((3, 1, 3)))
    assert np.allclose(splats.opacities, 1 / (1 + np.exp(-logits)), rtol=1e-7)
    assert np.allclose(splats.scales, np.exp(logs), rtol=1e-7) and splats.rotations[0, 0] == 1
    assert np.allclose(logits_from_opacities(1 / (1 + np.exp(-np.array([-9.0, 0, 5])))), [-9, 0, 5])


def test_degree_0_colors_are_view_independent():
    colors = RNG.uniform(size=(4, 3))
    seen = np.einsum("dk,nkc->ndc", eval_harmonics(fibonacci_directions(5), 0), harmonics_from_colors(colors)) + 0.5
    assert np.allclose(seen, colors[:, None])


def test_quaternions_match_rotation_matrices():
    a, b = Rotation.random(4, random_state=RNG), Rotation.random(4, random_state=RNG)
    wxyz = lambda r: r.as_quat()[:, [3, 0, 1, 2]]
    assert np.allclose(quaternions_to_matrices(wxyz(a)), a.as_matrix())
    assert np.allclose(quaternions_to_matrices(multiply_quaternions(wxyz(a), wxyz(b))), (a * b).as_matrix())


def test_transform_preserves_appearance():
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
        ({"harmonics": np.zeros((6, 5, 3))}, "degree 0 to 3"),
    ],
)
def test_invalid_splats_are_refused(changes, said):
    with pytest.raises(ValueError, match=said):
        some(**changes)


def test_values_are_clamped_to_valid_ranges():
    splats = some(opacities=np.linspace(-1, 2, 6), scales=np.zeros((6, 3)))
    assert splats.opacities.min() == 0 and splats.opacities.max() == 1 and splats.scales.min() > 0
