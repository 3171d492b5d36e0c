import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nerg_mi.rays.filters import fixation_rays, idt, ivt
from nerg_mi.rays.rays import Rays


def gaze(azimuth, elevation=0.0, dt=0.02, person=None, t=None):
    """Rays of somebody whose gaze turns: degrees at steps of ``dt`` seconds."""
    a, e = np.broadcast_arrays(np.radians(np.asarray(azimuth, float)), np.radians(elevation))
    d = np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], axis=1)
    n = len(d)
    return Rays(
        np.arange(n) * dt if t is None else t,
        np.zeros(n) if person is None else person,
        ("ann", "bo"),
        np.tile([0, 0, 1.6], (n, 1)),
        d,
        np.ones(n),
    )


# Ten rays at 0 degrees, a saccade of two, ten at 20, one at 40, ten at 60: 50 Hz.
SEQUENCE = [*[0] * 10, 8, 16, *[20] * 10, 40, *[60] * 10]
WANT = np.array([*[0] * 10, -1, -1, *[1] * 10, -1, *[2] * 10])


def test_ivt_by_hand():
    label = ivt(gaze(SEQUENCE), velocity=100)
    # A ray belongs to the run that its step leads into: the first of a run comes after a fast step.
    assert label.tolist() == WANT.tolist()
    # 8 degrees in 0.02 s are 400 a second: a limit above that joins the first two.
    assert len(set(ivt(gaze(SEQUENCE), velocity=450)) - {-1}) == 2
    # Nine steps of 0.02 s are 0.18 s.
    assert (ivt(gaze(SEQUENCE), velocity=100, least=0.19) == -1).all()


def test_idt_by_hand():
    assert idt(gaze(SEQUENCE), dispersion=1.0).tolist() == WANT.tolist()
    # Within five degrees 16 joins 20.
    assert idt(gaze(SEQUENCE), dispersion=5.0).tolist() == [*WANT[:11], 1, *WANT[12:]]
    # A slow drift of half a degree a ray: no velocity finds its end, the dispersion does, every seven rays (3 degrees).
    drift = gaze(0.5 * np.arange(28))
    assert idt(drift, dispersion=3.01).tolist() == [k // 7 for k in range(28)] and (ivt(drift) == 0).all()
    # Sideways and upwards add up.
    both = gaze(0.5 * np.arange(28), 0.5 * np.arange(28))
    assert idt(both, dispersion=3.05, least=0.04).tolist() == [k // 4 for k in range(28)]


@pytest.mark.parametrize("find", [ivt, idt])
def test_people_and_pauses_end_fixations(find):
    still = gaze(
        [0] * 40,
        person=np.r_[np.zeros(20), np.ones(20)],
        t=np.r_[np.arange(20) * 0.02 + (np.arange(20) >= 10), np.arange(20) * 0.02],
    )
    assert find(still).tolist() == [0] * 10 + [1] * 10 + [2] * 20
    order = np.random.default_rng(0).permutation(40)
    assert np.array_equal(find(still.select(order)), find(still)[order])


@pytest.mark.parametrize("find", [ivt, idt])
def test_a_pause_of_a_tenth_of_a_second_ends_a_fixation_unless_told_otherwise(find):
    paused = lambda gap: gaze([0] * 20, t=np.arange(20) * 0.02 + (np.arange(20) >= 10) * (gap - 0.02))
    assert (
        len(set(find(paused(0.09)))) == 1
        and len(set(find(paused(0.11)))) == 2
        and len(set(find(paused(0.11), gap=0.12))) == 1
    )


def test_straight_up_is_measured_as_anywhere():
    """Who looks straight up has no level: what they look at next is as far away as it is."""
    for degrees, parts in ((2.9, 1), (3.1, 2)):
        polar = np.r_[np.zeros(5), np.full(5, degrees)]
        d = np.stack([np.sin(np.radians(polar)), np.zeros(10), np.cos(np.radians(polar))], axis=1)
        up = Rays(np.arange(10) * 0.02, np.zeros(10), ("ann",), np.zeros((10, 3)), d, np.ones(10))
        assert len(set(idt(up, dispersion=3.0, least=0.04))) == parts


@pytest.mark.parametrize("elevation", [0.0, 60.0, -85.0])
def test_dispersion_is_measured_on_the_sphere(elevation):
    # Where gaze is steep, a degree of azimuth is less: 3 degrees of arc are kept together, 4 are not.
    arc = lambda degrees: gaze(np.linspace(0, degrees / np.cos(np.radians(elevation)), 12), elevation)
    assert (idt(arc(2.0), dispersion=3.0) == 0).all() and len(set(idt(arc(6.0), dispersion=3.0, least=0.04))) > 1


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_idt_by_definition(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 120))
    azimuth = np.cumsum(rng.choice([0.2, 6.0], n, p=[0.9, 0.1]) * rng.choice([-1, 1], n))
    label = idt(gaze(azimuth), dispersion=2.1)  # no sum of steps
    # Salvucci and Goldberg's loop, for gaze that turns sideways only.
    want, s, number = np.full(n, -1), 0, 0
    while s < n:
        e = s + 5  # 0.1 s
        if e >= n:
            break
        if np.ptp(azimuth[s : e + 1]) <= 2.1:
            while e + 1 < n and np.ptp(azimuth[s : e + 2]) <= 2.1:
                e += 1
            want[s : e + 1] = number
            number, s = number + 1, e + 1
        else:
            s += 1
    assert label.tolist() == want.tolist()


def test_one_ray_a_fixation():
    rays = gaze([*[0, 2] * 5, *[40] * 10])
    hit = np.full((20, 3), np.nan)
    hit[:4] = rays.origin[:4] + 2 * rays.direction[:4]
    rays = Rays(rays.t, rays.person, rays.persons, rays.origin, rays.direction, rays.confidence, hit)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a fixation without a hit is nothing to be warned of
        one, seconds = fixation_rays(rays, idt(rays))
    assert len(one) == 2 and np.allclose(seconds, 0.18) and np.allclose(one.t, [0.09, 0.29])
    assert np.allclose(np.degrees(np.arctan2(one.direction[:, 1], one.direction[:, 0])), [1, 40])
    assert np.allclose(one.hit[0], hit[:4].mean(axis=0)) and np.isnan(one.hit[1]).all()
    with pytest.raises(ValueError, match="no fixation"):
        fixation_rays(rays, np.full(20, -1))
    with pytest.raises(ValueError, match="velocity must be positive"):
        ivt(rays, velocity=0)


@pytest.mark.parametrize("find", [ivt, idt])
@pytest.mark.parametrize("gap", [0.02, -0.1, 0.0, -1000.0])
def test_two_people_are_never_one_fixation(find, gap):
    """Somebody's first ray may come any time after, or before, another one's last, in the very same direction."""
    t = np.arange(20) * 0.02
    still = gaze([0] * 40, person=np.r_[np.zeros(20), np.ones(20)], t=np.r_[t, t + t[-1] + gap])
    assert find(still).tolist() == [0] * 20 + [1] * 20
    # Each stay is too short by itself; together they would not be.
    assert (find(still, least=0.5) == -1).all()


def test_a_fixation_has_the_mean_head():
    rays = gaze([*[0, 2] * 5, *[40] * 10])
    head = np.tile([1.0, 0, 0], (20, 1))
    head[1], head[2], head[10:] = [0, 1, 0], [np.nan] * 3, np.nan
    one, _ = fixation_rays(replace(rays, head=head), idt(rays))
    want = np.array([8.0, 1, 0])
    assert np.allclose(one.head[0], want / np.linalg.norm(want)) and np.isnan(one.head[1]).all()


@pytest.mark.parametrize("find", [ivt, idt])
def test_a_pause_as_long_as_it_may_be(find):
    still = gaze([0] * 9, dt=0.125)
    assert (find(still, gap=0.125) == 0).all() and (find(still, gap=0.12) == -1).all()


@pytest.mark.parametrize("find", [ivt, idt])
def test_a_fixation_as_short_as_it_may_be(find):
    still = gaze([0] * 3, dt=0.125)
    assert (find(still, least=0.25, gap=0.2) == 0).all() and (find(still, least=0.251, gap=0.2) == -1).all()
