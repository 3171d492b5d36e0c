"""Tests of `nerg_mi.aoi.flat`: gaze at chosen points of flat areas, and their pictures."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.aoi.flat import FlatArea, draw_area, sum_kernels
from nerg_mi.errors import NergError
from nerg_mi.maths.geometry import Similarity
from nerg_mi.tracking.objects import ObjectPoses
from nerg_mi.tracking.rays import Rays, merge_rays

pytestmark = pytest.mark.usefixtures("rgb")

SIZE = np.array([1.6, 0.9])
CORNER = np.array([3.0, 2.0, 1.8])  # upper left, seen from x = 0
AXES = np.array([[0.0, -1, 0], [0, 0, -1]])
PILLAR = np.array([[1.5, 0.9, 0.0], [1.6, 1.1, 3.0]])


def corners(corner=CORNER, axes=AXES, size=SIZE):
    across, down = size[:, None] * axes
    return np.array([corner, corner + across, corner + across + down, corner + down])


def look(count=400, seed=2):
    """Gaze from around the origin at random points of the area: the rays, and the points (N, 2) in metres."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 1, (count, 2)) * SIZE
    eyes = rng.uniform([-1, -0.5, 1.2], [1, 2, 1.8], (count, 3))
    people = np.repeat(["ann", "bob"], count // 2)
    return Rays.from_arrays(eyes, CORNER + xy @ AXES - eyes, times=np.arange(count) / 50, participants=people), xy


def crosses(box, o, d):
    """Whether rays cross a box in front of them."""
    sides = np.sort((box[:, None] - o) / d, axis=0)
    return sides[0].max(axis=1) < sides[1].min(axis=1)


def cube(box):
    import mitsuba as mi

    half, middle = (box[1] - box[0]) / 2, box.mean(axis=0)
    return {"type": "cube", "to_world": mi.ScalarTransform4f().translate(middle.tolist()).scale(half.tolist())}


def painted_poster():
    """The area in a thin box whose quarters are red, green, blue and white, from the upper left one by rows."""

    shapes = {}
    for k, rgb in enumerate(([0.8, 0, 0], [0, 0.8, 0], [0, 0, 0.8], [0.8, 0.8, 0.8])):
        low = CORNER + (np.array([k % 2, k // 2]) / 2 * SIZE) @ AXES
        high = low + SIZE / 2 @ AXES + [0.02, 0, 0]
        shapes[f"quarter {k}"] = cube(np.sort([low, high], axis=0))
        shapes[f"quarter {k}"]["bsdf"] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": rgb}}
    return shapes


@pytest.mark.parametrize("scale", [1.0, 4.0])
def test_samples_have_the_coordinates_of_their_points(scale, tmp_path):
    rays, xy = look()
    elsewhere = Rays.from_arrays([[0, 0, 1.5]] * 2 + [[9, 1, 1.5]], [[0, 1, 0], [0, 0, -1], [-1, 0, 0]], times=range(3))
    align = Similarity(np.diag([scale, scale, scale, 1.0]))
    scene = {"pillar": cube(scale * PILLAR), **{k: v for k, v in painted_poster().items() if scale == 1}}
    shape = {"align": align, "corners": scale * corners(), "resolution": 320, "smoothing_length": 0.03}
    gaze = draw_area([rays, scene], **shape)
    columns = gaze.samples
    assert gaze.color.shape == (180, 320, 3) and gaze.size == pytest.approx((1.6, 0.9))
    assert np.allclose(np.column_stack([columns["x"], columns["y"]]), xy, atol=1e-9)
    assert np.allclose(np.column_stack([columns["x_px"], columns["y_px"]]), xy / 0.005, atol=1e-6)
    assert np.allclose(columns["distance"], np.linalg.norm(CORNER + xy @ AXES - rays.origin, axis=1))
    hidden = crosses(PILLAR, rays.origin, rays.direction)
    assert 20 < hidden.sum() < 200 and np.array_equal(columns["occluded"] == 1, hidden)
    assert columns["participant"].tolist() == ["ann"] * 200 + ["bob"] * 200
    with pytest.raises(NergError):
        draw_area([elsewhere, scene], **shape)
    gaze.save(tmp_path / "a.png", samples=tmp_path / "a.csv", image=tmp_path / "b.png")
    with (tmp_path / "a.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["x"]) for row in rows] == columns["x"].tolist() and (tmp_path / "b.png").exists()


def test_the_density_is_a_sum_of_gaussians():
    rays, xy = look(60)
    gaze = draw_area(rays, corners=corners(), resolution=160, smoothing_length=0.05)
    assert np.isnan(gaze.samples["occluded"]).all()
    y, x = (np.indices(gaze.density.shape) + 0.5) * 0.01
    square = (x - xy[:, 0, None, None]) ** 2 + (y - xy[:, 1, None, None]) ** 2
    expected = (np.exp(-square / (2 * 0.05**2)) / (2 * np.pi * 0.05**2)).mean(axis=0)
    assert np.abs(gaze.density - expected).max() < 0.05 * expected.max()
    # In degrees, at the distance of each sample.
    eyes = [Rays.from_arrays([[3 - d, 1.2, 1.35]], [[1, 0, 0]], times=[0]) for d in (1.0, 3.0)]
    near, far = (draw_area(rays, corners=corners(), resolution=320, smoothing=2).density.max() for rays in eyes)
    assert near / far == pytest.approx(9, rel=0.1) and near == pytest.approx(1 / (2 * np.pi * 0.035**2), rel=0.1)


def test_kernels_have_their_widths():
    at = np.array([[40.2, 30.7], [41.0, 30.0]])
    for sigma in (0.0, 2.0, 5.1):
        total = sum_kernels(at[:1], np.array([sigma]), (64, 96))
        y, x = np.indices(total.shape)
        assert total.sum() == pytest.approx(1) and (total * x).sum() == pytest.approx(40)
        assert np.sqrt((total * (x - 40) ** 2).sum()) == pytest.approx(sigma, rel=0.02, abs=1e-6)
    assert sum_kernels(at, np.array([2.0, 9.0]), (64, 96)).max() == pytest.approx(0.04, rel=0.1)


def test_recorded_hit_points_tell_what_is_occluded():
    rays, xy = look()
    distance = np.linalg.norm(CORNER + xy @ AXES - rays.origin, axis=1)
    ends = np.where(np.arange(400) % 4 == 0, 0.5, 1.0) * distance
    hit = rays.origin + ends[:, None] * rays.direction
    hit[3::4] = np.nan
    occluded = draw_area(replace(rays, hit=hit), corners=corners()).samples["occluded"]
    assert np.array_equal(np.nan_to_num(occluded, nan=2).reshape(-1, 4), [[1, 0, 0, 2]] * 100)


def test_the_picture_is_seen_from_the_front():
    rays, _ = look(20)
    for area in ({"corners": corners()}, {"aois": {"poster": [[3, 0.4, 0.9], [3.1, 2, 1.8]]}}):
        color = draw_area([rays, painted_poster()], resolution=32, **area).color
        quarters = color.reshape(2, 9, 2, 16, 3).mean(axis=(1, 3)).reshape(4, 3)
        assert np.allclose(quarters / quarters.max(axis=1, keepdims=True), [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])


def test_more_samples_per_pixel_have_less_noise():
    import mitsuba as mi

    rays, _ = look(20)
    half = mi.ScalarTransform4f()
    lamp = {"type": "rectangle", "to_world": half.look_at([1, 1.2, 1.4], [3, 1.2, 1.4], [0, 0, 1]).scale([0.4, 0.4, 1])}
    lamp["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
    scene = {"type": "scene", "integrator": {"type": "path", "max_depth": 2}, "lamp": lamp, **painted_poster()}
    area = {"corners": corners(), "resolution": 64}
    exact, *others = (draw_area([rays, scene], spp=spp, **area).color for spp in (4096, 4, 64))
    few, many = (np.sqrt(((color - exact) ** 2).mean()) for color in others)
    assert few / many == pytest.approx(4, rel=0.15) and many < 0.2 * exact.mean()


def test_gaze_on_an_area_that_moves():
    rays, xy = look()
    turn = Rotation.from_euler("z", 3 * rays.t[:, None], degrees=True)
    move = 0.05 * rays.t[:, None] * [1, 1, 0.5]
    target = turn.apply(CORNER + xy @ AXES) + move
    rays = Rays.from_arrays(rays.origin, target - rays.origin, times=rays.t)
    poses = ObjectPoses.from_arrays(["poster"] * 400, rays.t, move, turn.as_quat())
    board = {"poster": cube(np.array([[3.0, 0.4, 0.9], [3.05, 2, 1.8]])), "pillar": cube(PILLAR)}
    gaze = draw_area([rays, board], aois={"poster": {"shape": "poster"}}, objects=poses)
    assert np.allclose(np.column_stack([gaze.samples["x"], gaze.samples["y"]]), xy, atol=1e-6)
    assert np.array_equal(gaze.samples["occluded"] == 1, crosses(PILLAR, rays.origin, rays.direction))
    still = draw_area([rays, board], aois={"poster": {"shape": "poster"}})
    assert len(still.samples["x"]) < 400 or not np.allclose(still.samples["x"], xy[:, 0], atol=0.02)


def test_rectangles_are_found():
    import mitsuba as mi
    import trimesh

    from nerg_mi.aoi.areas import Areas
    from nerg_mi.aoi.flat import _fit_area
    from nerg_mi.aoi.placed import open_placed_areas

    def fit(area, observer, scene=None):
        placed = open_placed_areas(scene, None, Areas.load({"a": area}))
        return _fit_area(placed, (0,), np.array([observer], float))

    flat = fit([[3, 0.4, 0.9], [3.1, 2, 1.8]], [0, 1, 1.5])
    assert np.allclose(flat.corner, CORNER) and np.allclose(flat.axes, AXES) and np.allclose(flat.size, SIZE)
    behind = fit([[3, 0.4, 0.9], [3.1, 2, 1.8]], [6, 1, 1.5])
    assert np.allclose(behind.corner, [3.1, 0.4, 1.8]) and np.allclose(behind.axes, [[0, 1, 0], [0, 0, -1]])
    # A turned box, and a picture that hangs askew on it.
    turned = fit({"min": [2, -1, 0], "max": [2.2, 1, 2], "turn": 30}, [0, 0, 1])
    assert np.allclose(turned.axes, [[0.5, -np.sqrt(0.75), 0], [0, 0, -1]]) and np.allclose(turned.size, 2)
    sheet = trimesh.Trimesh(corners(), [[0, 1, 2], [0, 2, 3]])
    assert np.allclose(fit(sheet, [0, 1, 1]).corner, CORNER)
    to_world = mi.ScalarTransform4f().look_at([3, 1.2, 1.35], [0, 1.2, 1.35], [0, 0, 1]).scale([0.8, 0.45, 1])
    plane = {"a": {"type": "rectangle", "to_world": to_world}}
    assert np.allclose(fit({"shape": "a"}, [0, 1, 1], plane).corner, CORNER, atol=1e-6)
    # On a table, the lower border is that next to the observers.
    table = fit([[0, 0, 0.7], [1, 2, 0.72]], [0.5, -1, 1.6])
    assert np.allclose(table.corner, [0, 2, 0.72]) and np.allclose(table.axes, [[1, 0, 0], [0, -1, 0]])
    with pytest.raises(NergError):
        fit([[0, 0, 0], [1, 1, 1]], [5, 0, 1])
    with pytest.raises(NergError):
        fit({"shape": "a"}, [5, 0, 1], {"a": {"type": "sphere"}})


def test_the_front_is_the_side_that_is_seen():
    rays, _ = look()
    # More people walk behind the wall at whose front the others look.
    eyes = np.tile([8.0, 1.2, 1.5], (1000, 1))
    crowd = Rays.from_arrays(eyes, eyes - [0, 1, 0], times=np.arange(1000) / 50, participants=["cy"] * 1000)
    box, wall = [[3, 0.4, 0.9], [3.02, 2, 1.8]], cube(np.array([[3.02, -5, 0], [3.2, 7, 3]]))
    gaze = draw_area([merge_rays([rays, crowd]), {"wall": wall}], aois={"a": box}, resolution=32)
    assert len(gaze.samples["t"]) == len(rays) and not gaze.samples["occluded"].any()


def test_groups_are_refused():
    aois = {"a": [[3, 0.4, 0.9], [3.1, 1, 1.8]], "b": [[3, 1.4, 0.9], [3.1, 2, 1.8]], "both": {"parts": ["a", "b"]}}
    with pytest.raises(NergError):
        draw_area(look()[0], aois=aois, area="both", resolution=32)


def test_corners_are_those_of_a_rectangle():
    rng = np.random.default_rng(1)
    for _ in range(5):
        turn = Rotation.random(random_state=rng).as_matrix()
        axes, corner = AXES @ turn.T, rng.normal(size=3)
        measured = corners(corner, axes) + rng.uniform(-0.01, 0.01, (4, 3))
        flat = FlatArea.from_corners(measured)
        assert np.allclose(flat.axes @ flat.axes.T, np.eye(2))
        assert np.allclose(flat.axes, axes, atol=0.04) and np.allclose(flat.corner, corner, atol=0.03)
    exact, bent = corners(), corners()
    bent[1, 2] += 0.4
    for wrong in (
        exact[:3],
        exact[[0, 2, 1, 3]],
        exact[[0, 0, 0, 0]],
        exact + [[0, 0, 0], [0, 0, 0.4], [0, 0, 0], [0, 0, 0]],
    ):
        with pytest.raises(NergError):
            FlatArea.from_corners(wrong)


def test_one_area_is_chosen():
    rays, _ = look(10)
    two = {"poster": [[3, 0.4, 0.9], [3.1, 2, 1.8]], "other": [[3, 2.4, 0.9], [3.1, 3, 1.8]]}
    assert len(draw_area(rays, aois=two, area="poster").samples["t"]) == 10
    for arguments in ({"aois": two}, {"aois": two, "area": "x"}, {}, {"aois": two, "corners": corners()}):
        with pytest.raises(NergError):
            draw_area(rays, **arguments)
    with pytest.raises(NergError):
        draw_area({"poster": cube(PILLAR)}, corners=corners())
