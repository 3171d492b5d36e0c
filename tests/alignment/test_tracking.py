"""Tests of `nerg_mi.alignment.tracking`."""

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.alignment.constraints import AlignmentTarget, surface_from_traces
from nerg_mi.alignment.similarity import MIRROR, residual_distances
from nerg_mi.alignment.tracking import DECLARED, Tracking, candidate_scales, compare_flips, is_close, search_placements
from nerg_mi.errors import NergError
from nerg_mi.photos.posed import read_semidense
from nerg_mi.tracking.readers.registry import read_rays
from tests.alignment import rooms

# ---- Flips ----

RNG = np.random.default_rng(3)

POINTS = RNG.uniform([0, 0, 0], [6, 4, 2.5], (400, 3))

TURN = np.array([[0, -2, 0, 5], [2, 0, 0, -1], [0, 0, 2, 3], [0, 0, 0, 1.0]])  # by 90 degrees, to twice the size


def gaze(count=200, off=0.002):
    """Participants who look at points to about a tenth of a degree, with heads about 15 degrees off."""
    origin = RNG.uniform([1, 1, 1.4], [5, 3, 1.8], (count, 3))
    to = POINTS[RNG.integers(0, len(POINTS), count)] - origin
    direction = to / np.linalg.norm(to, axis=1, keepdims=True) + RNG.normal(0, off, (count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    head = direction + RNG.normal(0, 0.15, (count, 3))
    return origin, direction, head / np.linalg.norm(head, axis=1, keepdims=True)


def moved(points):
    return points @ TURN[:3, :3].T + TURN[:3, 3]


def test_angles_match_a_loop():
    origin, direction, _ = gaze(20, 0.05)
    result = compare_flips(moved(POINTS), TURN, origin, direction).degrees
    assert set(result) == {DECLARED, *(f"{a} of the directions negated" for a in "xyz")}
    for name, signs in ((DECLARED, (1, 1, 1)), ("y of the directions negated", (1, -1, 1))):
        expected = []
        for o, d in zip(origin, direction * signs):
            cosines = [(p - o) @ d / np.linalg.norm(p - o) for p in POINTS]
            expected.append(np.degrees(np.arccos(max(cosines))))
        # Rays are processed in random order.
        assert np.allclose(np.sort(result[name]), np.sort(expected), atol=1e-5)


def test_correct_axes_give_no_warning():
    assert compare_flips(moved(POINTS), TURN, *gaze()).warning() is None


@pytest.mark.parametrize("axis", range(3))
def test_negated_axis_is_reported(axis):
    origin, direction, head = gaze()
    wrong = direction * np.where(np.arange(3) == axis, -1, 1)
    assert f"with {'xyz'[axis]} of the directions negated" in str(
        compare_flips(moved(POINTS), TURN, origin, wrong).warning()
    )


@pytest.mark.parametrize("name", ["left and right", "up and down"])
def test_exchanged_head_axes_are_reported(name):
    origin, direction, head = gaze()
    left = np.stack([-head[:, 1], head[:, 0], np.zeros(len(head))], axis=1)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    axis = left if name == "left and right" else np.cross(head, left)
    wrong = direction - 2 * np.sum(direction * axis, axis=1, keepdims=True) * axis
    assert f"with {name} of the eyes exchanged" in str(
        compare_flips(moved(POINTS), TURN, origin, wrong, head).warning()
    )


def test_few_rays_and_chance_give_no_warning():
    origin, direction, head = gaze(20)
    assert compare_flips(POINTS, np.eye(4), origin, direction * (1, 1, -1), head).warning() is None
    origin, _, head = gaze()
    anywhere = RNG.normal(size=(200, 3))
    anywhere /= np.linalg.norm(anywhere, axis=1, keepdims=True)
    assert compare_flips(POINTS, np.eye(4), origin, anywhere, head).warning() is None


def test_unknown_heads_are_ignored():
    origin, direction, head = gaze()
    head[:, :] = np.nan
    result = compare_flips(POINTS, np.eye(4), origin, direction, head).degrees
    assert np.array_equal(result["up and down of the eyes exchanged"], result[DECLARED])


# ---- Search ----


def test_search_finds_rotation_shift_and_scale():
    rays, truth = rooms.people(1500), rooms.similarity(np.random.default_rng(2), upright=True)
    surface = surface_from_traces(rooms.traces().transform(truth), 1 << 16)
    scales = candidate_scales(surface, rays.hit)
    scale = np.cbrt(np.linalg.det(truth[:3, :3]))
    assert scales[0] > scale > scales[-1] and np.abs(np.log(scales / scale)).min() < 0.04
    near = scales[np.abs(np.log(scales / scale)) < 0.3]
    best, *remaining = search_placements(surface, rays.hit, rays.origin, near, (0.0, truth[2, 3]))
    moved, right = (rooms.carried(m, rays.origin) for m in (best.matrix, truth))
    assert np.median(np.linalg.norm(moved - right, axis=1)) < 0.3 * scale
    assert all(o.score <= best.score and not is_close(o.matrix, best.matrix, 0.02) for o in remaining)


# ---- Tracking ----

RAYS = rooms.people(1200)


def quiet(share, text):
    assert 0 <= share <= 1 and text


@pytest.mark.nightly
def test_tracking_alone_and_mirrored_tracking():
    truth = rooms.similarity(np.random.default_rng(7), upright=True)
    target = AlignmentTarget(traces=rooms.traces(25_000).transform(truth))
    fit = Tracking(RAYS).fit(target, quiet)
    off = residual_distances(fit.matrix, RAYS.origin, rooms.carried(truth, RAYS.origin))
    assert np.median(off) < 0.03 and fit.mirrored is None and np.median(fit.residuals_cm) < 6
    assert fit.metadata["heads_in_solids"] < 0.02 and np.median(fit.residuals_deg) < 3
    flipped = replace(
        RAYS,
        origin=rooms.carried(MIRROR, RAYS.origin),
        direction=RAYS.direction * (-1, 1, 1),
        hit=rooms.carried(MIRROR, RAYS.hit),
    )
    assert "if an axis is negated" in Tracking(flipped).fit(target, quiet).mirrored


def test_initial_similarity_is_refined():
    truth = rooms.similarity(np.random.default_rng(8))
    nudge = np.eye(4)
    nudge[:3, 3] = 0.08, -0.06, 0.05
    fit = Tracking(RAYS, truth @ nudge).fit(
        AlignmentTarget(traces=rooms.traces(25_000).transform(truth), is_upright=False), quiet
    )
    assert np.median(residual_distances(fit.matrix, RAYS.origin, rooms.carried(truth, RAYS.origin))) < 0.02


@pytest.mark.parametrize(
    "changes, expected, why",
    [
        ({}, {"is_upright": False}, "needs the up direction"),
        ({}, {"tracking_floor": None}, "give it with floor_height"),
        ({"hit": None}, {}, "do not determine turn and scale"),
        (None, {}, "no gaze samples"),
    ],
)
def test_undetermined_alignments_are_refused(changes, expected, why):
    rays = RAYS.select(RAYS.t < 0) if changes is None else replace(RAYS, **changes)
    with pytest.raises(NergError, match=why):
        Tracking(rays).fit(AlignmentTarget(**expected), quiet)


# ---- Recorded gaze of Aria's glasses against the points that they triangulated ----


@pytest.mark.parametrize("file", ["eye_gaze/generalized_eye_gaze.csv", "eye_gaze_vergence/generalized_gaze.csv"])
def test_each_planted_flip_is_reported(file, recorded):
    sample = recorded("aria") / "gen1" / "mps_sample"
    rays, points = read_rays("aria", sample / file), read_semidense(sample / "trajectory" / "global_points.csv.gz")
    flips = compare_flips(points, np.eye(4), rays.origin, rays.direction, rays.head)
    assert flips.warning() is None and np.median(flips.degrees[DECLARED]) < 0.2
    left = np.cross((0, 0, 1), rays.head)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    mistakes = {f"{'xyz'[k]} of the directions negated": np.eye(3)[k][None] for k in range(3)}
    mistakes |= {"left and right of the eyes": left, "up and down of the eyes": np.cross(rays.head, left)}
    for name, axis in mistakes.items():
        wrong = rays.direction - 2 * np.sum(rays.direction * axis, axis=1, keepdims=True) * axis
        assert name in str(compare_flips(points, np.eye(4), rays.origin, wrong, rays.head).warning())
