"""Plans of a scene, and figures of statistics."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PatchCollection

from nerg_mi.aoi.charts import aois_figure, transitions_figure
from nerg_mi.figures.maps import (
    PARTICIPANT_COLORS,
    ParticipantPath,
    SightLines,
    Walls,
    alignment_figure,
    camera_figure,
    floor_figure,
    floor_plan,
    layout_figure,
)
from nerg_mi.figures.style import DPI, encode, figure_of, rasterize, save
from nerg_mi.tracking.rays import Rays

# ---- Alignment figures ----


@pytest.mark.parametrize("place", [None, np.random.default_rng(0).uniform(0, 4, (500, 3))])
def test_alignment_figure_has_four_plans(place):
    points, heads = np.random.default_rng(1).uniform(0, 2, (2, 300, 3))
    shift = np.eye(4)
    shift[:3, 3] = 1, 2, 0
    figure = figure_of(alignment_figure(place, points, heads, shift, cut_height=3.0))
    assert [a.get_title(loc="left") for a in figure.axes] == [
        f"{when}, {view}" for when in ("before", "after") for view in ("from above", "from the side")
    ]
    kinds = 2 if place is None else 3
    for axes, moved in zip(figure.axes, (points, points, points + (1, 2, 0), points + (1, 2, 0))):
        assert len(axes.collections) == kinds
        drawn = axes.collections[-2].get_offsets()
        b = 1 if axes in (figure.axes[0], figure.axes[2]) else 2
        np.testing.assert_allclose(np.sort(drawn[:, 1]), np.sort(moved[:, b]))


def test_ceiling_is_cut_in_views_from_above():
    place = np.array([[0.0, 0, 0], [1, 1, 1], [0, 0, 3], [1, 0, 3]])
    figure = figure_of(alignment_figure(place, place, None, np.eye(4), cut_height=2.0))
    assert [len(a.collections[0].get_offsets()) for a in figure.axes] == [2, 4, 2, 4]


# ---- Cameras and points from above and from the side ----


def poses() -> np.ndarray:
    out = np.tile(np.eye(4), (5, 1, 1))
    out[:, 0, 3] = np.arange(5)
    return out


def test_camera_figure_shows_cameras_and_points(tmp_path):
    points = np.random.default_rng(0).uniform(-1, 6, (500, 3))
    points[0] = 1e6
    figure = figure_of(camera_figure(poses(), points, np.full((500, 3), 90, np.uint8), "5 of 6 pictures"))
    above, side = figure.axes
    assert (above.get_xlabel(), above.get_ylabel(), side.get_ylabel()) == ("x", "y", "z")
    for axes in figure.axes:
        # The path, and a wedge each.
        assert len(axes.lines) == 6 and 400 < len(axes.collections[0].get_offsets()) < 500
        assert axes.get_xlim()[0] < 0 and 4 < axes.get_xlim()[1] < 20
    save(figure, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 1000


def test_camera_wedges_open_in_viewing_direction():
    """OpenGL cameras look along -z, which is down from the side."""
    wedge = figure_of(camera_figure(poses()[:1], np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "")).axes[1].lines[1]
    assert min(wedge.get_ydata()) <= 0 and max(wedge.get_ydata()) == 0


# ---- Floor plan ----

LOW, HIGH = np.array([0.0, 0.0]), np.array([4.0, 3.0])


def walls():
    height = np.zeros((30, 40))
    height[:, 30:] = np.nan
    height[10:20, 10:20] = 0.6
    cut = np.zeros((30, 40), bool)
    cut[0] = True
    return Walls(LOW, HIGH, height, cut, 1.2)


def test_walls_are_drawn_in_place():
    page = figure_of(floor_figure(LOW, HIGH, walls()))
    (image,) = page.axes[0].images
    assert tuple(image.get_extent()) == (0, 4, 0, 3) and image.origin == "lower"
    grey = image.get_array()[..., 0]
    assert np.all(grey[0] == grey[0, 0]) and grey[0, 0] < 0.3  # the cut is darkest
    assert np.all(grey[1:, 30:] == 1) and grey[15, 15] < grey[5, 5] < 1  # nothing is white; the higher, the darker
    assert [t.get_text() for t in page.axes[0].get_legend().get_texts()] == [
        "cut at 1.2 m",
        "lower objects",
        "no surface below",
    ]


def test_paths_have_gaps():
    places = np.array([[0.5, 0.5], [1, 0.5], [3, 2], [3.2, 2.2]])
    page = figure_of(
        floor_figure(LOW, HIGH, paths=[ParticipantPath("Ada", places, np.array([True, False, True, False]))])
    )
    line = next(l for l in page.axes[0].lines if len(l.get_xdata()) > 2)
    xy = np.stack([line.get_xdata(), line.get_ydata()], axis=1)
    np.testing.assert_array_equal(xy[~np.isnan(xy[:, 0])], places)
    assert (
        list(np.isnan(xy[:, 0])) == [True, False, False, True, False, False]
        and line.get_color() == PARTICIPANT_COLORS[0]
    )


def test_lines_of_sight_and_fields_of_view():
    origins, ends = np.array([[1.0, 1], [2, 2]]), np.array([[1.0, 2], [3, 2]])
    sight = SightLines(origins, ends, np.array([0, 1]))
    page = figure_of(floor_figure(LOW, HIGH, rays=sight, fields=sight, fov=40))
    (lines,) = [c for c in page.axes[0].collections if isinstance(c, LineCollection)]
    np.testing.assert_array_equal(np.stack(lines.get_segments()), np.stack([origins, ends], axis=1))
    (wedges,) = [c for c in page.axes[0].collections if isinstance(c, PatchCollection)]
    for path, o, e in zip(wedges.get_paths(), origins, ends):
        away = path.vertices - o
        extent = np.linalg.norm(away, axis=1).max()
        assert extent == pytest.approx(np.linalg.norm(e - o), rel=0.02)
        tip = away[np.linalg.norm(away, axis=1) > 0.5 * extent]
        angle = np.degrees(np.arccos(np.clip((tip / np.linalg.norm(tip, axis=1)[:, None]) @ ((e - o) / extent), -1, 1)))
        assert angle.max() == pytest.approx(20, abs=1.5)
    names = [t.get_text() for t in page.axes[0].get_legend().get_texts()]
    assert names == ["lines of sight", "field of view, 40°"]


def test_legend_of_many_participants():
    walk = lambda k: ParticipantPath(
        f"somebody with a rather long name {k}", np.array([[0.1 * k, 0.1], [1, 1]]), np.array([True, False])
    )
    page = figure_of(floor_figure(LOW, HIGH, walls(), [walk(k) for k in range(20)], title="20 people"))
    page.canvas.draw()
    texts = page.axes[0].get_legend().get_texts()
    assert len(texts) == 12 and texts[-1].get_text() == "and 12 more participants"
    boxes = [t.get_window_extent().extents for t in (*texts, *page.texts)]
    for k, a in enumerate(boxes):
        assert a[0] >= 0 and a[3] <= page.bbox.height and a[2] <= page.bbox.width
        for b in boxes[:k]:
            assert min(a[2], b[2]) - max(a[0], b[0]) <= 0.5 or min(a[3], b[3]) - max(a[1], b[1]) <= 0.5


def test_figures_are_reproducible():
    made = [encode(floor_figure(LOW, HIGH, walls()), suffix) for suffix in (".png", ".svg") for _ in range(2)]
    assert made[0] == made[1] and made[2] == made[3]


# ---- Ray figures ----


@pytest.fixture(scope="module")
def rays():
    """900 samples at (1, 1) and a hundred on a 4 x 2 m floor; all look along +x at a wall at x = 6."""
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


def test_density_is_samples_per_square_metre(rays):
    figure = figure_of(floor_plan(rays, cell=0.25))
    (mesh,) = [c for c in figure.axes[0].collections if hasattr(c, "_coordinates")]
    density = np.ma.filled(mesh.get_array(), 0.0)
    assert np.isclose(density.sum() * 0.25**2, 1000)
    assert (
        "1,000 samples of 3 participants" in figure.axes[0].get_title(loc="left")
        and "samples/m²" in figure.axes[1].get_ylabel()
    )
    (arrows,) = [c for c in figure.axes[0].collections if hasattr(c, "U")]
    assert (arrows.U > 0).all() and np.allclose(arrows.V, 0)


def test_axes_are_metres_of_equal_scale(rays):
    for figure in (
        figure_of(floor_plan(rays)),
        figure_of(layout_figure(rays)),
        figure_of(layout_figure(rays, rays, rays.origin[:5], 0.25)),
    ):
        axes = figure.axes[0]
        figure.canvas.draw()
        a, b = axes.transData.transform([(0, 0), (1, 1)])
        assert np.isclose(b[0] - a[0], b[1] - a[1], rtol=1e-3)
        assert (np.array(figure.get_size_inches()) * DPI < 1000).all()


def test_layout_shows_dimensions(rays):
    texts = {t.get_text() for t in figure_of(layout_figure(rays)).axes[0].texts}
    x, y = np.ptp(rays.origin[:, 0]), np.ptp(rays.origin[:, 1])
    assert {f"{x:.2f} m", f"{y:.2f} m"} <= texts
    legend = [t.get_text() for t in figure_of(layout_figure(rays, rays)).axes[0].get_legend().get_texts()]
    assert legend == ["training samples", "test samples", "gaze hit points"]
    bare = Rays(rays.t, rays.person, rays.persons, rays.origin, rays.direction, rays.confidence)
    assert [t.get_text() for t in figure_of(layout_figure(bare)).axes[0].get_legend().get_texts()] == ["samples"]
    one = bare.select([0])
    figure_of(floor_plan(one)), figure_of(layout_figure(one))  # a single place has no extent


# ---- Figures of statistics ----


def row(aoi, source, share):
    return dict(
        aoi=aoi, source=source, share=share, share_low=share / 2, share_high=2 * share, hit_ratio=None, dwell=1.0
    )


def test_bars_show_sorted_shares():
    page = figure_of(aois_figure([row("a", "measured", 0.1), row("b", "measured", 0.3), row("a", "predicted", 0.2)]))
    axis = page.axes[0]
    assert [t.get_text() for t in axis.get_yticklabels()] == ["a", "b"]
    assert sorted(p.get_width() for p in axis.patches) == [10.0, 30.0]
    lines = [line.get_xdata().tolist() for line in axis.lines]
    assert [5.0, 20.0] in lines and [20.0] in lines
    assert rasterize(page).std() > 5


def test_transitions_are_row_percentages():
    page = figure_of(transitions_figure(["a", "b"], np.array([[0, 3.0], [0, 0]])))
    assert page.axes[0].images[0].get_array().filled(0).tolist() == [[0, 100], [0, 0]]
    assert rasterize(page).std() > 5


def test_figure_without_areas():
    assert rasterize(aois_figure([])).shape[2] == 3
