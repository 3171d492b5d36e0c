"""Tests of `nerg_mi.reports.data`."""

from __future__ import annotations

import base64
import json
import math
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.aoi.placed import BoxAoi as Solid
from nerg_mi.aoi.placed import HitAssignment
from nerg_mi.aoi.shares import Shares
from nerg_mi.environment.environment import Environment
from nerg_mi.environment.scene import make_scene
from nerg_mi.evaluation.gaze_report import GazeResults, small_sample_factor
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_product import GazeConfig, ProductHead
from nerg_mi.fields.mlp import namespace
from nerg_mi.formats.boxes import Region
from nerg_mi.maths.geometry import Box, Similarity
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.reports.data import (
    ParticipantLabels,
    anonymize_rays,
    anonymize_results,
    assign_ray_hits,
    downsample_points,
    estimate_normals,
    farthest_point_sampling,
    make_proxy,
    make_report_sampler,
    mean_over_participants,
    normals_from_image,
    pack_stage,
    sample_eye_positions,
    summarize_objects,
)
from nerg_mi.tracking.rays import Rays
from nerg_mi.transport.geometry import SceneGeometry
from tests.evaluation.test_gaze import crowd
from tests.reports.made import full_run, minimal_run, stage

# ---- Viewpoints in a hall of four walls with closed-form depths ----

LOW, HIGH = np.array([-2.0, -6.0, 0.0]), np.array([2.0, 6.0, 3.0])


@pytest.fixture
def hall(rgb):
    """A gaze sampler with a random field, inside a box in metres."""
    to_world = rgb.ScalarTransform4f().translate((0.5 * (LOW + HIGH)).tolist()).scale((0.5 * (HIGH - LOW)).tolist())
    scene = rgb.load_dict({"type": "scene", "box": {"type": "cube", "to_world": to_world, "flip_normals": True}})
    box = Box(tuple(LOW), tuple(HIGH))
    config = GazeConfig(grid=HashGridConfig(levels=4, log2_rows=10, base=4, finest=16), width=16, normalized=True)
    field = ProductHead.random(config, box, namespace(rgb.variant()), 3)
    place = Environment(SceneGeometry(None, scene), box, "scene")
    return make_report_sampler(field, place), place


def aois(boxes):
    return [Solid(box) for box in boxes], [(k,) for k in range(len(boxes))]


def to_wall(o, d):
    """Distance from ``o`` within the box to its walls along ``d``, axis by axis."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(d == 0, np.inf, np.where(d > 0, (HIGH - o) / d, (LOW - o) / d)).min(axis=-1)


def test_gaze_query_covers_the_sphere(hall):
    onlooker, _ = hall
    d = fibonacci_directions(512)
    for eye in np.array([[0.3, -2.0, 1.6], [-1.0, 4.0, 1.5]]):
        (gaze,), distance = onlooker.query_from(eye)(d)
        assert np.allclose(distance, to_wall(eye, d), atol=1e-4)
        assert np.allclose(gaze, onlooker.density(eye, d), rtol=1e-5) and np.ptp(gaze) > 0


def test_density_at_visible_and_hidden_points(hall):
    onlooker, _ = hall
    eye = np.array([0.3, -2.0, 1.6])
    on_wall, behind = np.array([2.0, 1.0, 1.0]), np.array([4.0, 4.0, 0.4])
    points = np.array([on_wall, behind])
    away = points - eye
    direction = away / np.linalg.norm(away, axis=1, keepdims=True)
    result = onlooker.density_at_points(eye, points, 0.02)
    assert result[0] == pytest.approx(onlooker.density(eye, direction)[0], rel=1e-5) and result[0] > 0
    assert result[1] == 0


def test_few_directions_suffice_for_normalization(hall):
    onlooker, _ = hall
    d = fibonacci_directions(8192)
    assert 4 * np.pi * onlooker.density(np.array([0.3, -2.0, 1.6]), d).mean() == pytest.approx(1, abs=0.02)


def test_viewpoints_per_participant_are_equal(hall):
    _, place = hall
    rays = crowd(1000)
    observers = sample_eye_positions(rays, place, 12)
    assert np.bincount(observers.participant).tolist() == [3, 3, 3, 3]
    times = [np.flatnonzero((rays.origin == p).all(axis=1))[0] for p in observers.positions[observers.participant == 0]]
    assert (np.diff(times) > 200).all()  # spread over the whole of the time
    few = sample_eye_positions(rays, place, 2)
    assert len(few.positions) == 2 and len(set(few.participant)) == 2


def test_viewpoints_cover_whole_recordings(hall):
    """Participants walk from one end to the other; single viewpoints must not all be at the middle of the path."""
    _, place = hall
    people, each = 40, 50
    walked = np.tile(np.linspace(-5, 5, each), people)
    origin = np.stack([np.zeros_like(walked), walked, np.full_like(walked, 1.6)], axis=1)
    person, t = np.repeat(np.arange(people), each), np.tile(np.arange(each, dtype=float), people)
    names = tuple(f"p{k}" for k in range(people))
    rays = Rays(t, person, names, origin, np.tile([1.0, 0, 0], (len(t), 1)), np.ones(len(t)))
    for max_count in (people, 3 * people):
        along = np.sort(sample_eye_positions(rays, place, max_count).positions[:, 1])
        assert len(along) == max_count and np.abs(along - np.linspace(-5, 5, max_count)).max() < 0.5


def test_rays_end_at_hit_points_or_surfaces(hall):
    onlooker, place = hall
    rays = crowd(300)
    rows = np.linspace(0, 299, 100).round().astype(int)
    boxes = [Region.create("left", (-9, -9, -9), (9, 0.1, 9)), Region.create("low", (-9, -9, -9), (9, 9, 1.2))]
    landed, person = assign_ray_hits(rays, place, onlooker, 100, *aois(boxes), 0.0)
    assert landed.count == 100 and np.array_equal(person, rays.person[rows])
    expected = [np.flatnonzero(box.contains(rays.hit[rows])) for box in boxes]
    assert all(np.array_equal(a, b) and len(b) for a, b in zip(landed.rows, expected))
    landed, _ = assign_ray_hits(replace(rays, hit=None), place, onlooker, 300, *aois(boxes), 0.0)
    inside = np.flatnonzero(((rays.origin > LOW) & (rays.origin < HIGH)).all(axis=1))
    is_hit = rays.origin + to_wall(rays.origin, rays.direction)[:, None] * rays.direction
    for box, result in zip(boxes, landed.rows):
        assert np.array_equal(np.intersect1d(result, inside), inside[box.contains(is_hit[inside])])


def test_rays_in_another_frame(hall, rgb):
    """Rotated by 90 degrees about z, scaled by two and translated."""
    onlooker, place = hall
    matrix = np.array([[0, -0.1, 0, 1], [0.1, 0, 0, 0], [0, 0, 0.1, 0.5], [0, 0, 0, 1.0]])
    turned = Environment(place.medium, place.box, "scene", align=Similarity(matrix))
    rays = crowd(50)
    observers = sample_eye_positions(rays, turned, 4)
    every = rays.origin @ matrix[:3, :3].T + matrix[:3, 3]
    assert all(np.isclose(every, e).all(axis=1).any() for e in observers.positions)
    box = Region.create("some", (-9, -9, -9), (9, 9, 0.65))
    landed, _ = assign_ray_hits(rays, turned, onlooker, 50, *aois([box]), 0.0)
    expected = np.flatnonzero(box.contains(rays.hit @ matrix[:3, :3].T + matrix[:3, 3]))
    assert np.array_equal(landed.rows[0], expected) and 0 < len(expected) < 50


def test_rays_meet_nothing_without_geometry(rgb):
    box = Box((-2.0,) * 3, (2.0,) * 3)
    grid = HashGridConfig(levels=2, log2_rows=8, base=4, finest=8)
    field = ProductHead.random(GazeConfig(grid=grid, width=16), box, namespace(rgb.variant()), 1)
    onlooker = make_report_sampler(field, Environment(None, box, "none"))
    depth, is_hit = onlooker.trace(np.zeros((3, 3)), np.eye(3))
    assert not is_hit.any() and not depth.any()


# ---- Anonymisation ----

NAMES = ("Grace", "Ada", "Ada Lovelace", "X")


def named():
    rays = crowd(500)
    metadata = dict(
        frame=rays.metadata["frame"],
        rows_read=600,
        sources=[{"file": "Ada.csv", "sha256": "0"}],
        dropped=[{"reason": "blink", "file": "Ada.csv", "count": 2, "rows": [[1, 2]]}],
        steps=[{"step": "filter", "kept": 9, "of": 10, "persons": ["Ada"]}],
        remark="Ada was tired",
    )
    return replace(rays, persons=NAMES, metadata=metadata)


def test_participants_are_numbered_by_sample_count():
    rays = named()
    count = np.bincount(rays.person)
    labels = ParticipantLabels(rays)
    order = [NAMES[i] for i in np.argsort(-count, kind="stable")]
    assert [labels.label(name) for name in order] == [
        "participant 1",
        "participant 2",
        "participant 3",
        "participant 4",
    ]
    shown = anonymize_rays(rays, labels)
    assert shown.persons == ("participant 1", "participant 2", "participant 3", "participant 4")
    assert [shown.persons[p] for p in shown.person] == [labels.label(rays.persons[p]) for p in rays.person]
    assert np.array_equal(shown.origin, rays.origin)


def test_all_names_are_replaced():
    shown = anonymize_rays(named(), ParticipantLabels(named()))
    text = repr(shown.metadata) + repr(shown.persons)
    assert "Ada" not in text and "Grace" not in text and shown.metadata["dropped"][0]["file"] == "file 1"
    assert shown.metadata["steps"] == [{"step": "filter", "kept": 9, "of": 10}]


def test_names_in_files_and_evaluations_are_replaced():
    row = {"method": "gaze field", "person": "Ada", "bits": 1.0}
    result = GazeResults("g", "", "both", 1, 2, 20.0, (), (row, {**row, "person": "somebody else"}))
    labels = ParticipantLabels(named(), [result])
    shown = anonymize_results(result, labels)
    assert [r["person"] for r in shown.participant_rows] == [labels.label("Ada"), "participant 5"] and row[
        "person"
    ] == "Ada"
    assert labels.anonymize("ada_lovelace-ADA LOVELACE.npz") == (
        f"{labels.label('Ada')}_lovelace-{labels.label('Ada Lovelace')}.npz"
    )
    # A single letter is replaced as a whole word only.
    assert labels.anonymize("X and axis") == f"{labels.label('X')} and axis"
    assert ParticipantLabels(None).anonymize("a.b") == "a.b" and ParticipantLabels(None).label("Ada") == "a participant"


# ---- Attention on AOIs, against direct counts and a bootstrap ----


def of_field(share, seen=None):
    share = np.array(share, float)[:, None]
    seen = share > 0 if seen is None else np.array(seen)[:, None]
    none = np.zeros(len(share))
    return Shares(share, 0 * share, seen, share, none, none + 1, share[None])


def on_rows(rows, count):
    return HitAssignment(count, (np.array(rows, int),), (np.ones(len(rows)),))


def test_participants_have_equal_weight():
    rng = np.random.default_rng(0)
    who, person = np.array([3, 3, 3, 5, 9, 9, 9, 9]), rng.choice([3, 5, 9], 300)
    share, rows = rng.random(len(who)), np.flatnonzero(rng.random(300) < 0.3)
    (result,) = summarize_objects(["unit"], of_field(share), who, (on_rows(rows, 300), person))
    field, rays = {}, {}
    for value, one in zip(share, who.tolist()):
        field.setdefault(one, []).append(value)
    for k, one in enumerate(person.tolist()):
        rays.setdefault(one, []).append(k in rows)
    mean = lambda each: sum(sum(v) / len(v) for v in each.values()) / len(each)
    assert result.predicted.mean == pytest.approx(mean(field)) and result.recorded.mean == pytest.approx(mean(rays))
    assert (result.num_could_see, result.num_looked, result.num_participants) == (3, 3, 3)


def test_participants_with_view_are_counted():
    # The second viewpoint of participant 0 sees the box, without gaze on it.
    field, who, person = of_field([0, 0, 0, 0], [False, True, False, False]), np.array([0, 0, 1, 2]), np.arange(4)
    (result,) = summarize_objects(["unit"], field, who, (on_rows([], 4), person))
    assert (result.num_could_see, result.num_looked, result.num_participants) == (1, 0, 4)
    # A participant with a sample on the AOI counts as having a view.
    (result,) = summarize_objects(["unit"], field, who, (on_rows([1, 2], 4), person))
    assert (result.num_could_see, result.num_looked) == (2, 2)


def test_objects_without_samples():
    (result,) = summarize_objects(["unit"], of_field([0.25]), np.zeros(1, int))
    assert result.recorded is None and result.num_participants is None and math.isnan(result.predicted.low)


def test_interval_matches_the_bootstrap():
    rng = np.random.default_rng(2)
    values = rng.beta(2, 9, 40)
    result = mean_over_participants(values)
    means = [rng.choice(values, 40).mean() for _ in range(20_000)]
    assert result.mean == pytest.approx(values.mean())
    assert result.high - result.mean == pytest.approx(1.96 * np.std(means) * small_sample_factor(40), rel=0.02)
    assert result.mean - result.low == pytest.approx(result.high - result.mean)


def test_intervals_stay_within_0_and_1():
    assert mean_over_participants(np.array([0.0, 0.0, 0.0, 0.9])).low == 0.0  # noqa: RUF069 (a bound)
    assert mean_over_participants(np.array([1.0, 1.0, 1.0, 0.1])).high == 1.0  # noqa: RUF069 (a bound)
    assert math.isnan(mean_over_participants(np.array([0.2, 0.3])).low)


# ---- Scene proxy ----

PROXY_LOW, PROXY_HIGH = np.array([-2.0, -3.0, 0.0]), np.array([2.0, 3.0, 3.0])


@pytest.fixture
def room(rgb):
    to_world = (
        rgb.ScalarTransform4f()
        .translate((0.5 * (PROXY_LOW + PROXY_HIGH)).tolist())
        .scale((0.5 * (PROXY_HIGH - PROXY_LOW)).tolist())
    )
    red = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.1, 0.1]}}
    box = {"type": "cube", "to_world": to_world, "flip_normals": True, "bsdf": red}
    light = {"type": "point", "position": [0, 0, 1.5], "intensity": {"type": "rgb", "value": [9.0, 9, 9]}}
    inner = {"type": "path", "max_depth": 2}
    scene = make_scene(shapes={"box": box, "light": light}, inner=inner, aovs="opacity,position")
    return scene.mitsuba


def test_proxy_points_lie_on_walls(room):
    observers = np.array([[0.0, 0, 1.5], [1, 2, 1.0]])
    texts = []
    gaze = lambda observer, points, spacing: np.linalg.norm(points - observer, axis=1)
    up = np.array([0.0, 0, 1])
    result = make_proxy(room, observers, up, observers[:1], gaze, 3000, (96, 48), lambda *done: texts.append(done))
    p = result.vertices
    to_wall = np.minimum(np.abs(p - PROXY_LOW), np.abs(p - PROXY_HIGH)).min(axis=1)
    assert 500 < len(p) <= 3000 and to_wall.max() < 0.5 * result.spacing + 1e-3 and texts == [(1, 2), (2, 2)]
    # Points near an edge mix two walls.
    flat = np.sort(np.minimum(np.abs(p - PROXY_LOW), np.abs(p - PROXY_HIGH)), axis=1)[:, 1] > 2 * result.spacing
    centre = (PROXY_LOW + PROXY_HIGH) / 2
    inward = ((centre - p) * result.normals).sum(axis=1)
    assert (inward[flat] > 0).all() and (np.abs(result.normals[flat]).max(axis=1) > 0.98).mean() > 0.95
    assert np.allclose(np.linalg.norm(result.normals, axis=1), 1, atol=1e-4)
    lit = result.colors[result.colors.max(axis=1) > 60]
    assert len(lit) > 100 and (lit[:, 0] > lit[:, 1]).all()  # a red room
    assert np.allclose(result.gaze[0], np.linalg.norm(p - observers[0], axis=1), atol=1e-4)
    for side in range(3):
        for end in (PROXY_LOW, PROXY_HIGH):
            assert (np.abs(p[:, side] - end[side]) < result.spacing).any()


def test_downsampling_separates_sides_of_a_wall():
    rng = np.random.default_rng(0)
    flat = np.concatenate([rng.uniform(0, 4, (4000, 2)), np.zeros((4000, 1))], axis=1)
    points = np.concatenate([flat, flat + [0, 0, 1e-4]])
    normals = np.repeat([[0.0, 0, -1], [0, 0, 1]], 4000, axis=0)
    colors = np.repeat([[1.0, 0, 0], [0, 0, 1]], 4000, axis=0)
    p, c, edge = downsample_points(points, normals, colors, 500)
    assert len(p) <= 500 and set(map(tuple, np.round(c, 6))) == {(1, 0, 0), (0, 0, 1)}
    # Every point has a representative in its cube.
    offset = np.linalg.norm(points[:, None, :] - p[None], axis=2).min(axis=1)
    assert offset.max() <= edge * np.sqrt(2) + 1e-9


def test_downsampling_keeps_few_points():
    p = np.array([[0.0, 0, 0], [1, 1, 1]])
    result = downsample_points(p, np.array([[0.0, 0, 1]] * 2), np.ones((2, 3)), 10)
    assert np.allclose(result[0], p)
    alone = downsample_points(p[:1], np.array([[0.0, 0, 1]]), np.ones((1, 3)), 10)
    assert np.allclose(alone[0], p[:1]) and alone[2] > 0


def test_normals_of_a_plane_and_an_edge():
    u, v = np.meshgrid(np.linspace(-1, 1, 20), np.linspace(-1, 1, 10))
    plane = np.stack([u, v, 0.5 * u + 2], axis=-1)
    expected = np.array([0.5, 0, -1]) / np.sqrt(1.25)
    normals = normals_from_image(plane, -plane)
    assert np.allclose(normals[:, 1:-1], expected, atol=1e-6)
    step = np.where(u[..., None] < 0, plane, plane + [0, 0, 5])
    assert np.allclose(normals_from_image(step, -step)[:, 1:-1], expected, atol=1e-6)
    hole = plane.copy()
    hole[4, 7] = np.nan
    assert np.isfinite(normals_from_image(hole, -np.nan_to_num(hole, nan=1.0))).all()


def test_normals_of_a_noisy_sphere():
    rng = np.random.default_rng(1)
    outward = rng.normal(size=(4000, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    points = outward * (2 + rng.normal(0, 0.003, (4000, 1)))
    result = estimate_normals(points, [0.3, 0.1, 0.5] + 5 * outward)
    assert np.percentile((result * outward).sum(axis=1), 5) > 0.97 and np.allclose(np.linalg.norm(result, axis=1), 1)
    assert np.allclose(estimate_normals(points[:2], 3 * outward[:2]), outward[:2])


def test_farthest_point_sampling():
    line = np.linspace(0, 10, 11)[:, None] * [1.0, 0, 0]
    assert sorted(farthest_point_sampling(line, 3, first=np.zeros(3)).tolist()) == [
        3,
        5,
        10,
    ] or farthest_point_sampling(line, 2, first=np.zeros(3)).tolist() == [10, 5]
    assert farthest_point_sampling(line, 2).tolist() == [0, 10]
    assert (
        len(farthest_point_sampling(np.zeros((5, 3)), 3)) == 1
        and len(farthest_point_sampling(np.zeros((0, 3)), 3)) == 0
    )


# ---- Verdicts ----


def test_verdicts():
    ((results, verdict),) = full_run().verdicts
    assert results.split == "both" and verdict.grade == "use"
    assert minimal_run().verdicts == [] and minimal_run().provenance == {}


# ---- Packed 3D view ----


def unpacked(text):
    metadata = json.loads(text)
    data = base64.b64decode(metadata["data"])
    kinds = {"place": "<u2", "paths": "<u2", "boxes": "<u2", "marks": "<u2"}
    arrays = {k: np.frombuffer(data[a : a + n], kinds.get(k, "u1")) for k, (a, n) in metadata["parts"].items()}
    return metadata, arrays


def positions(metadata, array):
    return np.array(metadata["lower"]) + array.reshape(-1, 3) / 65535 * np.array(metadata["size"])


def test_packed_arrays_round_trip():
    value = stage()
    metadata, arrays = unpacked(pack_stage(value))
    close = np.array(metadata["size"]).max() / 65535
    assert np.abs(positions(metadata, arrays["place"]) - value.proxy.vertices).max() <= close
    assert np.abs(arrays["normal"].reshape(-1, 3) / 255 * 2 - 1 - value.proxy.normals).max() <= 1 / 255 + 1e-6
    assert np.array_equal(arrays["color"].reshape(-1, 3), value.proxy.colors)
    assert np.abs(positions(metadata, arrays["marks"]) - value.observers).max() <= close
    paths = positions(metadata, arrays["paths"])
    assert [n for _, n in metadata["paths"]] == [9, 3]
    for (first, count), path in zip(metadata["paths"], value.paths):
        assert np.abs(paths[first : first + count] - path).max() <= close


def test_packed_gaze_of_each_observer_and_mean():
    value = stage()
    metadata, arrays = unpacked(pack_stage(value))
    heat = (arrays["gaze"].reshape(3, -1) / 255) ** 2
    for values, shown, who in zip([value.proxy.gaze.mean(axis=0), *value.proxy.gaze], heat, metadata["observers"]):
        assert who["top"] == pytest.approx(np.percentile(values, 99), rel=0.01)
        assert np.abs(np.minimum(values, who["top"]) / who["top"] - shown).max() < 0.015
    assert [who["marks"] for who in metadata["observers"]] == [[0, 1], [0], [1]]


def test_boxes_are_packed_as_edges():
    metadata, arrays = unpacked(pack_stage(stage((Region.create("b", np.array([0.0, 1, 2]), np.array([1.0, 3, 4])),))))
    edges = positions(metadata, arrays["boxes"]).reshape(12, 2, 3)
    lengths = np.sort(np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1))
    assert np.allclose(lengths, [1] * 4 + [2] * 8, atol=1e-3)
    assert len(np.unique(edges.reshape(-1, 3).round(3), axis=0)) == 8


def test_pack_without_observers():
    value = stage(())
    empty = replace(value.proxy, gaze=np.zeros((0, len(value.proxy.vertices)), np.float32))
    text = pack_stage(replace(value, proxy=empty, observers=np.zeros((0, 3)), paths=[]))
    metadata, arrays = unpacked(text)
    assert metadata["observers"] == [{"marks": [], "top": 0.0}] and not arrays["gaze"].any() and metadata["paths"] == []


def test_packed_scene_is_reproducible_and_safe():
    assert pack_stage(stage()) == pack_stage(stage()) and "<" not in pack_stage(stage())
