from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.rays import plausibility
from nerg_mi.rays.plausibility import walking_agreement
from nerg_mi.rays.rays import FRAME, Rays
from nerg_mi.rays.readers.frames import Frame
from nerg_mi.rays.summary import summarise


def walk(hit=True, frame=None, seed=0):
    """Two minutes of somebody who walks about at eye height and looks roughly ahead, at things two metres away."""
    rng = np.random.default_rng(seed)
    n = 6000
    t = np.arange(n) * 0.02
    heading = np.cumsum(rng.normal(0, 0.05, n))
    step = 0.02 * np.stack([np.cos(heading), np.sin(heading), np.zeros(n)], axis=1)
    origin = np.cumsum(step, axis=0) + [0, 0, 1.6]
    turned = heading + rng.normal(0, 0.6, n)
    d = np.stack([np.cos(turned), np.sin(turned), rng.normal(-0.2, 0.2, n)], axis=1)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    metadata = {"frame": dict(FRAME), "transform": Frame(**(frame or {})).to_rays().tolist()}
    return Rays(t, np.zeros(n), ("ann",), origin, d, np.ones(n), origin + 2 * d if hit else None, metadata)


def warnings_of(rays):
    return " | ".join(summarise(rays).warnings)


def test_nothing_to_say_of_a_plausible_walk():
    assert warnings_of(walk()) == "" and warnings_of(walk(hit=False)) == ""
    assert (walking_agreement(walk())[:2] > 0.5).all()


def test_directions_against_hit_points():
    rays = walk(frame={"up": "y", "handedness": "left"})  # the file's z is our y
    assert "with z of the directions negated they would" in warnings_of(
        replace(rays, direction=rays.direction * (1, -1, 1))
    )
    swapped = replace(rays, direction=rays.direction[:, [1, 0, 2]])
    assert "miss the hit points" in warnings_of(swapped) and "one frame" in warnings_of(swapped)


def test_directions_against_walking():
    rays = walk(hit=False, frame={"up": "y"})
    assert "reversed" in warnings_of(replace(rays, direction=rays.direction * (-1, -1, 1)))
    assert "along x of the file" in warnings_of(replace(rays, direction=rays.direction * (-1, 1, 1)))
    assert "along z of the file" in warnings_of(replace(rays, direction=rays.direction * (1, -1, 1)))


@pytest.mark.parametrize("scale, word", [(1000, "--units mm"), (100, "--units cm")])
def test_units(scale, word):
    rays = walk(hit=False)
    assert word in warnings_of(replace(rays, origin=rays.origin * scale))


def test_the_axis_that_is_up():
    # A file with y up that was declared with z up: heights stand in y.
    rays = walk(hit=False)
    assert "--up y" in warnings_of(replace(rays, origin=rays.origin[:, [0, 2, 1]]))
    assert "--up -x" in warnings_of(replace(rays, origin=rays.origin[:, [2, 0, 1]] * (-1, 1, 1)))
    assert "floor is not at height 0" in warnings_of(replace(rays, origin=rays.origin - (0, 0, 1.6)))


def test_times_and_steep_gaze():
    rays = walk(hit=False)
    assert "a ray comes every 20 s" in warnings_of(replace(rays, t=rays.t * 1000))
    down = np.tile([0.1, 0.1, -1.0], (len(rays), 1)) / np.linalg.norm([0.1, 0.1, -1.0])
    assert "degrees down" in warnings_of(replace(rays, direction=down))


@pytest.mark.parametrize("units", ["m", "cm", "mm"])
@pytest.mark.parametrize("up", ["y", "x", "-y"])
def test_axes_are_told_in_the_frame_of_the_file(units, up):
    """In its own axes, which a cyclic change of them, unlike a swap, tells from those of the rays; whatever its
    unit."""
    rays = walk(hit=False, frame={"up": up, "units": units})
    agreement, file_up = walking_agreement(rays), "xyz".index(up[-1])
    assert agreement[file_up] == 0 and (np.delete(agreement, file_up) > 0.5).all()
    # Heads that stand along another axis of the file than the one that was declared.
    turn = Frame(up=up).to_rays()[:3, :3]
    for standing in {"x", "y", "z"} - {up[-1]}:
        file = rays.origin[:, {"x": [2, 0, 1], "y": [1, 2, 0], "z": [0, 1, 2]}[standing]]
        assert f"(--up {standing})" in warnings_of(replace(rays, origin=file @ turn.T))


def test_some_runs_speak_for_millions(monkeypatch):
    """What people do is seen in runs of the rays of many, in whichever order they are."""
    monkeypatch.setattr(plausibility, "_WALKED", (4096, 512))
    rays = walk(hit=False)
    many = replace(rays, person=np.repeat(np.arange(6), 1000), persons=tuple("abcdef"))
    shuffled = many.select(np.random.default_rng(0).permutation(len(many)))
    for some in (many, shuffled):
        assert (walking_agreement(some)[:2] > 0.5).all()
        assert (walking_agreement(replace(some, direction=some.direction * (-1, -1, 1)))[:2] < -0.5).all()


def test_the_order_of_rays_makes_no_difference():
    rays = walk()
    mixed = rays.select(np.random.default_rng(3).permutation(len(rays)))
    assert np.allclose(walking_agreement(mixed), walking_agreement(rays))


@pytest.mark.parametrize("along", [0, 1])
def test_a_kilometre_is_the_most_that_origins_in_metres_span(along):
    """Heads at eye height: nothing but how far they are apart gives the unit away."""
    rays = walk(hit=False)
    for span, warned in ((999.5, False), (1000.5, True)):
        origin = rays.origin.copy()
        origin[:, along] *= span / np.ptp(origin[:, along])
        slow = replace(rays, origin=origin, t=rays.t * 40)  # nobody runs
        assert ("--units mm" in warnings_of(slow)) == warned


def test_walking_is_seen_through_the_noise_of_tracking():
    """Between one ray and the next heads seem to move by more than they walk; in half a second they do not."""
    rays = walk()
    noisy = rays.origin + np.random.default_rng(1).normal(0, 0.03, rays.origin.shape)
    assert (walking_agreement(replace(rays, origin=noisy))[:2] > 0.5).all()
