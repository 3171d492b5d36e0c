from dataclasses import replace

import numpy as np
import pytest

from tests.rays.checks.people import change, warnings_of, watch

BO = slice(3000, 6000)


@pytest.mark.parametrize("by, text", [(-20.0, "-20 s"), (3600.0, "+3,600 s"), (-3600.0, "-3,600 s")])
def test_a_clock_that_jumps_while_people_go_on(by, text):
    said = warnings_of(change(watch(), slice(4500, 6000), t=lambda t: t + by))
    assert f"the clock of bo jumps once, by {text} at most" in said and "mend the times" in said


def test_pauses_and_recordings_one_after_the_other_are_right():
    rays = watch()
    # Whoever goes away for ten minutes is somewhere else afterwards.
    gone = np.r_[0:1000, 1700:3000]
    assert warnings_of(change(rays, slice(1700, 3000), t=lambda t: t + 600.0).select(gone)) == ""
    # Files in another order than their times.
    later = change(rays, slice(0, 1500), t=lambda t: t + 1000.0)
    assert warnings_of(later.select(np.r_[0:1400, 1700:9000])) == ""


def test_recordings_under_one_name():
    rays = watch()
    shared = replace(rays, person=np.where(rays.person == 2, 1, rays.person))
    said = warnings_of(shared)
    assert "bo is at two places at the same times: do several people share a name? (--person-from" in said
    between = change(shared, slice(6000, None), t=lambda t: t + 0.003)
    assert "recordings of bo overlap in time" in warnings_of(between)
    twice = rays.select(np.r_[0:9000, 3000:6000])
    assert warnings_of(twice) == "rays of bo are there twice: was a file imported two times?"


def test_clocks_in_other_units():
    rays = watch(5)
    said = warnings_of(change(rays, BO, t=lambda t: 1000 * t))
    assert "a ray of bo comes every 20 s, and of others every 0.02 s" in said and "--tick" in said
    said = warnings_of(change(rays, slice(4500, 6000), t=lambda t: 30 + 1000 * (t - 30)))
    assert "the clock of bo changes its pace" in said and "two units" in said


def test_clocks_that_count_from_other_moments():
    rays = watch()
    assert "the clock of bo counts from another moment" in warnings_of(change(rays, BO, t=lambda t: t + 1.7e9))
    assert "(--clock person)" in warnings_of(change(rays, BO, t=lambda t: t + 1.7e9))
    # Recordings of one study may lie months apart.
    assert warnings_of(change(rays, BO, t=lambda t: t + 2e7)) == ""


def test_rays_that_were_chosen_say_nothing_of_clocks():
    rays = watch()
    slow = np.r_[0:3000, 3000:6000:40, 6000:9000]
    thinned = rays.select(slow).with_step(step="thin", kept=len(slow), of=len(rays))
    assert "comes every" in warnings_of(rays.select(slow)) and warnings_of(thinned) == ""
