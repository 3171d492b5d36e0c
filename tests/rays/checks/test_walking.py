from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.rays import direction_checks
from nerg_mi.rays.direction_checks import walking_agreement
from nerg_mi.rays.readers.base import Frame
from tests.rays.checks.people import walk, warnings_of


def test_directions_against_walking():
    rays = walk(hit=False, frame={"up": "y"})
    assert "reversed" in warnings_of(replace(rays, direction=rays.direction * (-1, -1, 1)))
    assert "along x of the file" in warnings_of(replace(rays, direction=rays.direction * (-1, 1, 1)))
    assert "along z of the file" in warnings_of(replace(rays, direction=rays.direction * (1, -1, 1)))


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
    monkeypatch.setattr(direction_checks, "_WALKED", (4096, 512))
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


def test_walking_is_seen_through_the_noise_of_tracking():
    """Between one ray and the next heads seem to move by more than they walk; in half a second they do not."""
    rays = walk()
    noisy = rays.origin + np.random.default_rng(1).normal(0, 0.03, rays.origin.shape)
    assert (walking_agreement(replace(rays, origin=noisy))[:2] > 0.5).all()


def test_of_some_of_the_people():
    """One who is reversed among others, by a walk that goes everywhere."""
    rays = walk(hit=False)
    two = replace(rays, person=np.repeat([0, 1], [4000, 2000]), persons=("ann", "bo"))
    back = two.direction.copy()
    back[4000:] *= (-1, -1, 1)
    assert "bo look back to where they came from" in warnings_of(replace(two, direction=back))


def test_gaze_that_stays_whichever_way_people_walk():
    """Gaze in the head's frame, of whose head nothing is known."""
    rays = walk(hit=False)
    rng = np.random.default_rng(0)
    local = rng.normal(0, 0.25, (6000, 3)) + (0, 1, 0)
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    said = warnings_of(replace(rays, direction=local))
    assert "stay about one direction of the file, whichever way people walk" in said and "--preset unity_local" in said
    both = replace(rays, person=np.repeat([0, 1], [4000, 2000]), persons=("ann", "bo"))
    half = both.direction.copy()
    half[:4000] = local[:4000]
    assert "the directions of ann stay about one direction" in warnings_of(replace(both, direction=half))
