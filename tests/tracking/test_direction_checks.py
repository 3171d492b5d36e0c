"""Tests of `nerg_mi.tracking.direction_checks`."""

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.tracking import direction_checks
from nerg_mi.tracking.direction_checks import DECLARED, compute_head_frames, compute_hit_fractions, describe_mirroring
from nerg_mi.tracking.readers.base import TrackingFrame
from tests.tracking.people import change, walk, warnings_of, watch

# ---- Directions ----


def test_directions_against_hit_points():
    rays = walk(frame={"up": "y", "handedness": "left"})  # the file's z is our y
    assert "with z of the directions negated it would be" in warnings_of(
        replace(rays, direction=rays.direction * (1, -1, 1))
    )
    swapped = replace(rays, direction=rays.direction[:, [1, 0, 2]])
    assert "miss the hit points" in warnings_of(swapped) and "same frame" in warnings_of(swapped)


def test_directions_of_some_against_hit_points():
    rays = walk()
    two = replace(rays, person=np.repeat([0, 1], [4500, 1500]), persons=("ann", "bo"))
    part = two.direction.copy()
    part[4500:] *= (1, -1, 1)
    said = warnings_of(replace(two, direction=part))
    assert "of the directions, those of bo, miss the hit points" in said and "with y of the directions negated" in said
    part[:4650] = two.direction[:4650]
    part[4800:] = two.direction[4800:]
    assert "miss" not in warnings_of(replace(two, direction=part))


# ---- Frames ----

BO, TWO = slice(3000, 6000), slice(3000, 9000)


def moved(rays, rows, matrix=((1, 0, 0), (0, 1, 0), (0, 0, 1)), shift=(0, 0, 0)):
    """Move some of the participants to another frame."""
    new = {name: getattr(rays, name).copy() for name in ("origin", "direction", "hit", "head")}
    for name, column in new.items():
        column[rows] = column[rows] @ np.asarray(matrix, float).T + (shift if name in ("origin", "hit") else 0)
    return replace(rays, **new)


@pytest.mark.parametrize("down, warned", [(1.6, True), (1.0, True), (-0.8, True), (0.3, False), (-0.2, False)])
def test_another_floor(down, warned):
    said = warnings_of(moved(watch(5), BO, shift=(0, 0, -down)))
    assert ("the heads of bo are" in said and "nerg align" in said) == warned and bool(said) == warned


def test_another_unit():
    rays = watch(5)
    for factor, unit in ((100, "cm"), (1000, "mm")):
        new = rays.origin.copy()
        new[BO] *= factor
        said = warnings_of(replace(rays, origin=new, hit=None))
        assert "the heads of bo are" in said and f"is their unit {unit}?" in said and f'units="{unit}"' in said


def test_heights_are_not_compared_without_a_floor():
    rays = moved(watch(5), BO, shift=(0, 0, -1.6))
    assert warnings_of(replace(rays, metadata={**rays.metadata, "floor": "unknown"})) == ""


def test_far_away():
    said = warnings_of(moved(watch(5), BO, shift=(0, 60, 0)))
    assert "bo is 5" in said and "m or more from all other recordings" in said
    # A walk from shop to shop: each is near another one.
    chain = watch(4)
    new = chain.origin + np.repeat(np.arange(4), 3000)[:, None] * (9, 0, 0)
    assert warnings_of(replace(chain, origin=new, hit=None)) == ""


@pytest.mark.parametrize(
    "matrix, what",
    [
        ([[0, -1, 0], [1, 0, 0], [0, 0, 1]], "a turn by -90 degrees"),
        ([[-1, 0, 0], [0, 1, 0], [0, 0, 1]], "x negated"),
        ([[-1, 0, 0], [0, -1, 0], [0, 0, 1]], "x and y negated"),
    ],
)
@pytest.mark.parametrize("rows", [BO, TWO])
def test_rotated_or_mirrored_frames(matrix, what, rows):
    said = warnings_of(moved(watch(5), rows, matrix))
    assert "walks where no other participant does" in said and f"with {what} (of rays)" in said


def test_rotation_within_a_room_is_not_detected():
    assert warnings_of(moved(moved(watch(5), slice(None), shift=(-4, -3, 0)), BO, np.diag([-1, -1, 1]))) == ""


def test_recordings_of_one_person_are_named_by_time():
    rays = watch(2)
    again = moved(rays, slice(1500, 3000), shift=(0, 0, -1.6))
    t = again.t + np.where(np.arange(6000) // 1500 == 1, 500.0, 0.0)
    assert "the heads of ann (from 530 s) are at a height of -0.1" in warnings_of(replace(again, t=t))


# ---- Head ----

HEAD_BO = slice(3000, 6000)


def bare(rays):
    """Rays for which only the heads are informative."""
    return replace(rays, hit=None)


def to_head(rays):
    return np.einsum("nij,nj->ni", compute_head_frames(rays.head.astype(float)), rays.direction)


def test_frames_of_heads():
    """Compare with cross products by hand: right of a head that looks along x is -y."""
    ahead = np.array([[1.0, 0, 0], [0, 1, 0], [0.6, 0, 0.8]])
    result = compute_head_frames(ahead)
    assert np.allclose(result[0], [[1, 0, 0], [0, -1, 0], [0, 0, 1]])
    assert np.allclose(result[1], [[0, 1, 0], [1, 0, 0], [0, 0, 1]])
    assert np.allclose(result[2], [[0.6, 0, 0.8], [0, -1, 0], [-0.8, 0, 0.6]])


@pytest.mark.parametrize("rows, who", [(slice(None), ""), (HEAD_BO, " of bo"), (slice(5400, 6000), " of bo")])
def test_gaze_in_the_head_frame_declared_as_world(rows, who):
    """As in a log of Unity: right, up and ahead in the head as if they were x, y and z of the world."""
    rays = bare(watch())
    local = to_head(rays)[:, [1, 0, 2]]
    said = warnings_of(change(rays, rows, direction=local[rows]))
    assert f"of the directions{who} are more than 60 degrees" in said
    assert "in the head's frame? (preset=" in said


def test_another_forward_axis():
    rays = bare(watch())
    assert "relative to the head they point right" in warnings_of(
        replace(
            rays,
            direction=np.einsum(
                "nij,ni->nj", compute_head_frames(rays.head.astype(float)), to_head(rays)[:, [2, 0, 1]]
            ),
        )
    )
    said = warnings_of(replace(rays, direction=-rays.direction))
    assert "100 % of the directions are more than 60 degrees" in said and "with x and y and z of the dir" in said


@pytest.mark.parametrize("axis", [0, 1])
def test_an_axis_negated(axis):
    rays = bare(watch())
    signs = np.where(np.arange(3) == axis, -1.0, 1.0)
    assert f"with {'xy'[axis]} of the directions negated this would not occur" in warnings_of(
        replace(rays, direction=rays.direction * signs)
    )
    # Axes are named as in the file: its z is y of the rays.
    unity = replace(rays, metadata={**rays.metadata, "transform": np.eye(4)[[0, 2, 1, 3]].tolist()})
    assert f"with {'xz'[axis]} of the directions negated" in warnings_of(
        replace(unity, direction=unity.direction * signs)
    )


def test_quaternions_in_other_order():
    """Quaternions read with w in the place of x: the gaze may point anywhere."""
    rng = np.random.default_rng(0)
    rays = bare(watch())
    d = rng.normal(size=rays.direction.shape)
    said = warnings_of(replace(rays, direction=d / np.linalg.norm(d, axis=1, keepdims=True)))
    assert "75 % of the directions are more than 60 degrees" in said
    assert "order of the quaternion (xyzw or wxyz)" in said


def test_gaze_opposite_to_or_independent_of_the_head():
    rays = bare(watch())
    flat = lambda v: v * (1, 1, 0.6) / np.linalg.norm(v * (1, 1, 0.6), axis=1, keepdims=True)
    level = replace(rays, direction=flat(rays.direction), head=flat(rays.head))
    assert warnings_of(level) == ""
    up = change(level, HEAD_BO, direction=lambda d: d * (1, 1, -1))
    assert "along z of the file the gaze of bo moves opposite to the head: negate z" in warnings_of(up)
    # Head and gaze are both within 40 degrees of straight ahead, but independent of each other.
    rng, n = np.random.default_rng(0), len(rays)
    around = lambda: np.repeat(rng.uniform(-0.5, 0.5, n // 16 + 1), 16)[:n]
    content = lambda yaw: np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], axis=1)
    assert "does not follow the head" in warnings_of(replace(rays, direction=content(around()), head=content(around())))


def test_unknown_heads_give_no_warning():
    rays = bare(watch())
    assert warnings_of(change(rays, slice(None), head=np.nan)) == ""
    assert warnings_of(change(rays, slice(0, 3500), head=np.nan)) == ""


# ---- Vestibulo-ocular reflex ----


def exchanged(rays, signs, rows=slice(None)):
    """Gaze with left and right, or up and down, of the eyes swapped."""
    frames = compute_head_frames(rays.head.astype(float))
    single = np.einsum("nij,nj->ni", frames, rays.direction)
    d = rays.direction.copy()
    d[rows] = np.einsum("nij,ni->nj", frames, single * signs)[rows]
    return replace(rays, direction=d, hit=None)


@pytest.mark.parametrize(
    "signs, word", [((1, -1, 1), "left and right of"), ((1, -1, -1), "left and right, and up and down,")]
)
def test_eyes_that_turn_with_the_head(signs, word):
    rays = watch()
    assert f"with {word}" in warnings_of(exchanged(rays, signs)) and warnings_of(exchanged(rays, (1, 1, 1))) == ""
    alone = warnings_of(exchanged(rays, signs, slice(3000, 6000)))
    assert f"the gaze of bo turns with the head instead of against it; with {word}" in alone


def test_runs_represent_many_rays(monkeypatch):
    monkeypatch.setattr(direction_checks, "_VOR_RUNS", (4096, 512))
    rays = watch()
    mixed = rays.select(np.random.default_rng(0).permutation(len(rays)))
    for some in (rays, mixed):
        assert "left and right" in warnings_of(exchanged(some, (1, -1, 1)))
        assert warnings_of(exchanged(some, (1, 1, 1))) == ""


# ---- Locked ----


def test_gaze_that_is_the_delayed_head_direction():
    rays = replace(watch(), hit=None)
    late = change(rays, slice(3000, 6000), direction=np.roll(rays.head, 1, axis=0)[3000:6000])
    assert "the gaze of bo stays within 4 degrees" in warnings_of(late)
    # Also with gaze at an angle to the head.
    turned = np.einsum("nij,i->nj", compute_head_frames(rays.head.astype(float)), (0.96, 0.0, -0.28))
    noisy = turned + np.random.default_rng(0).normal(0, 0.02, turned.shape)
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    assert "the gaze of ann, bo, cy stays within 4 degrees" in warnings_of(replace(rays, direction=noisy))


def test_still_head_with_still_eyes_is_valid():
    rays = replace(watch(), hit=None)
    rng, n = np.random.default_rng(1), len(rays)
    ahead = lambda spread: (v := rng.normal(0, spread, (n, 3)) + (1, 0, 0)) / np.linalg.norm(v, axis=1, keepdims=True)
    assert "one place in the head" not in warnings_of(replace(rays, head=ahead(0.02), direction=ahead(0.02)))


# ---- Mirror ----


def counter(origins, directions):
    """Distances to a plane z = 0 and a wall x = 3 up to 2.2, in closed form."""
    with np.errstate(divide="ignore", invalid="ignore"):
        down = np.where(directions[:, 2] < 0, -origins[:, 2] / directions[:, 2], np.inf)
        wall = np.where(directions[:, 0] > 0, (3 - origins[:, 0]) / directions[:, 0], np.inf)
        wall[origins[:, 2] + wall * directions[:, 2] > 2.2] = np.inf
    nearest = np.minimum(down, wall)
    return np.where(nearest < 20, nearest, np.inf)


@pytest.fixture
def gaze():
    """People in front of the wall who look at it or down."""
    rng = np.random.default_rng(0)
    d = rng.normal(size=(4000, 3)) * 0.1 + (1, 0, -0.2)
    return np.tile([1.0, 1, 1.6], (4000, 1)), d / np.linalg.norm(d, axis=1, keepdims=True)


def test_hit_fractions_and_their_names(gaze):
    origins, d = gaze
    shares = compute_hit_fractions(counter, origins, d)
    assert set(shares) == {DECLARED, "x", "y", "z", "x and y", "x and z", "y and z", "x and y and z"}
    assert shares["z"] == np.isfinite(counter(origins, d * (1, 1, -1))).mean()
    assert shares[DECLARED] > 0.99 and describe_mirroring(shares, 4000) is None
    for axis in (0, 2):
        signs = np.where(np.arange(3) == axis, -1, 1)
        said = describe_mirroring(compute_hit_fractions(counter, origins, d * signs), 4000)
        assert f"with {'xyz'[axis]} of the directions negated" in said and "handedness" in said
    # Without a wall in y, its sign is not detectable.
    assert describe_mirroring(compute_hit_fractions(counter, origins, d * (1, -1, 1)), 4000) is None


def test_axes_of_the_file(gaze):
    """A file with y up, left-handed: its y is z of the rays."""
    origins, d = gaze
    to_source = np.eye(3)[[0, 2, 1]]
    assert "with y of the dir" in describe_mirroring(
        compute_hit_fractions(counter, origins, d * (1, 1, -1), to_source), 4000
    )


def test_chance_is_no_reflection():
    shares = dict.fromkeys([DECLARED, "x", "y", "z"], 0.80)
    assert describe_mirroring({**shares, "y": 0.85}, 100) is None and describe_mirroring({**shares, "y": 0.85}, 5000)
    assert describe_mirroring({**shares, "y": 0.81}, 10**7) is None


# ---- Walking ----


def test_directions_against_walking():
    rays = walk(hit=False, frame={"up": "y"})
    assert "reversed" in warnings_of(replace(rays, direction=rays.direction * (-1, -1, 1)))
    assert "along x of the file" in warnings_of(replace(rays, direction=rays.direction * (-1, 1, 1)))
    assert "along z of the file" in warnings_of(replace(rays, direction=rays.direction * (1, -1, 1)))


@pytest.mark.parametrize("up, units", [("y", "m"), ("x", "cm"), ("-y", "mm")])
def test_axes_are_reported_in_the_frame_of_the_file(up, units):
    """Axes are those of the file, which a cyclic permutation, unlike a swap, distinguishes from those of the rays; for
    any unit."""
    rays = walk(hit=False, frame={"up": up, "units": units})
    # Heads are upright along another axis of the file than the declared one.
    turn = TrackingFrame(up=up).to_rays()[:3, :3]
    for standing in {"x", "y", "z"} - {up[-1]}:
        file = rays.origin[:, {"x": [2, 0, 1], "y": [1, 2, 0], "z": [0, 1, 2]}[standing]]
        assert f'(up="{standing}")' in warnings_of(replace(rays, origin=file @ turn.T))


def test_runs_represent_millions_of_rays(monkeypatch):
    """Runs of many rays suffice, in any order of the rays."""
    monkeypatch.setattr(direction_checks, "_WALK_RUNS", (4096, 512))
    rays = walk(hit=False)
    many = replace(rays, person=np.repeat(np.arange(6), 1000), persons=tuple("abcdef"))
    shuffled = many.select(np.random.default_rng(0).permutation(len(many)))
    for some in (many, shuffled):
        assert "reversed" not in warnings_of(some)
        assert "reversed" in warnings_of(replace(some, direction=some.direction * (-1, -1, 1)))


def test_walking_is_detected_in_noisy_positions():
    """Between successive rays, noise moves heads by more than walking; over half a second it does not."""
    rays = walk(hit=False)
    noisy = replace(rays, origin=rays.origin + np.random.default_rng(1).normal(0, 0.03, rays.origin.shape))
    assert "reversed" in warnings_of(replace(noisy, direction=rays.direction * (-1, -1, 1)))


def test_some_of_the_participants():
    """One reversed participant among others, in a walk in all directions."""
    rays = walk(hit=False)
    two = replace(rays, person=np.repeat([0, 1], [4000, 2000]), persons=("ann", "bo"))
    back = two.direction.copy()
    back[4000:] *= (-1, -1, 1)
    assert "bo look opposite to their direction of walking" in warnings_of(replace(two, direction=back))


def test_gaze_independent_of_the_heading():
    """Gaze in the head's frame without a recorded head."""
    rays = walk(hit=False)
    rng = np.random.default_rng(0)
    local = rng.normal(0, 0.25, (6000, 3)) + (0, 1, 0)
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    said = warnings_of(replace(rays, direction=local))
    assert "keep one direction of the file, whichever way people walk" in said and 'preset="unity_local"' in said
    both = replace(rays, person=np.repeat([0, 1], [4000, 2000]), persons=("ann", "bo"))
    half = both.direction.copy()
    half[:4000] = local[:4000]
    assert "the directions of ann keep one direction" in warnings_of(replace(both, direction=half))
