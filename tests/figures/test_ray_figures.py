import numpy as np
import pytest

from nerg_mi.figures.maps import floor_plan, layout_figure
from nerg_mi.figures.style import DPI
from nerg_mi.rays.rays import Rays


@pytest.fixture(scope="module")
def rays():
    """A crowd of 900 at (1, 1), a hundred over a 4 x 2 m floor; all look along +x at a wall at x = 6."""
    rng = np.random.default_rng(0)
    origin = np.concatenate([rng.normal([1, 1, 1.6], 0.05, (900, 3)), rng.uniform([0, 0, 1.5], [4, 2, 1.7], (100, 3))])
    d = np.tile([1.0, 0, 0], (1000, 1))
    return Rays(
        np.arange(1000) * 0.1,
        np.arange(1000) % 3,
        tuple("abc"),
        origin,
        d,
        np.ones(1000),
        origin + d * (6 - origin[:, :1]),
    )


def test_density_is_rays_a_square_metre(rays):
    figure = floor_plan(rays, cell=0.25)
    (mesh,) = [c for c in figure.axes[0].collections if hasattr(c, "_coordinates")]
    density = np.ma.filled(mesh.get_array(), 0.0)
    assert np.isclose(density.sum() * 0.25**2, 1000)
    assert "1,000 rays of 3 people" in figure.axes[0].get_title(loc="left") and "rays/m²" in figure.axes[1].get_ylabel()
    (arrows,) = [c for c in figure.axes[0].collections if hasattr(c, "U")]
    assert (arrows.U > 0).all() and np.allclose(arrows.V, 0)


def test_axes_are_metres_of_equal_scale(rays):
    for figure in (floor_plan(rays), layout_figure(rays), layout_figure(rays, rays, rays.origin[:5], 0.25)):
        axes = figure.axes[0]
        figure.canvas.draw()
        a, b = axes.transData.transform([(0, 0), (1, 1)])
        assert np.isclose(b[0] - a[0], b[1] - a[1], rtol=1e-3)
        assert (np.array(figure.get_size_inches()) * DPI < 1000).all()


def test_layout_says_how_far_the_rays_reach(rays):
    texts = {t.get_text() for t in layout_figure(rays).axes[0].texts}
    x, y = np.ptp(rays.origin[:, 0]), np.ptp(rays.origin[:, 1])
    assert {f"{x:.2f} m", f"{y:.2f} m"} <= texts
    legend = [t.get_text() for t in layout_figure(rays, rays).axes[0].get_legend().get_texts()]
    assert legend == ["training rays", "test rays", "what was looked at"]
    bare = Rays(rays.t, rays.person, rays.persons, rays.origin, rays.direction, rays.confidence)
    assert [t.get_text() for t in layout_figure(bare).axes[0].get_legend().get_texts()] == ["rays"]
    one = bare.select([0])
    floor_plan(one), layout_figure(one)  # a single place has no extent
