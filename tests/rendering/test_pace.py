"""Strips of samples: where they begin and end, and how long they become."""

import pytest

from nerg_mi.rendering import bands
from nerg_mi.rendering.bands import LEAST, PACKET, Pace


class Clock:
    """A clock that stands still but for ``take``."""

    def __init__(self, monkeypatch):
        self.now = 0.0
        monkeypatch.setattr(bands.time, "perf_counter", lambda: self.now)

    def take(self, it, seconds, times=1):
        for _ in range(times):
            self.now += seconds
            it.wait()


@pytest.mark.parametrize(("fixed", "spp"), [(1 << 12, 1), (1 << 12, 3), (100, 1), (0, 4)])
def test01_strips_follow_each_other_in_whole_packets_and_pixels(rgb, fixed, spp):
    start, stop = 1000 * spp, 1000 * spp + 50_000 * spp
    strips = list(Pace(fixed).strips(start, stop, spp))
    assert strips[0][0] == start - start % PACKET and sum(strips[-1]) == stop
    assert all(a + n == b for (a, n), (b, _) in zip(strips, strips[1:]))
    assert all((a + n) % PACKET == 0 == (a + n) % spp for a, n in strips[:-1])


def first_strip(it):
    return next(iter(it.strips(0, 1 << 22, 1)))[1]


def test02_short_ones_grow_and_long_ones_shrink_to_a_limit(rgb, monkeypatch):
    clock, it = Clock(monkeypatch), Pace()
    before = first_strip(it)
    # The first two are not asked: they were compiled, or wait for what was.
    clock.take(it, 0.01, 2)
    assert first_strip(it) == before
    clock.take(it, 0.01)
    assert first_strip(it) == 2 * before
    clock.take(it, 0.7 * bands.STRIP_SECONDS)
    assert first_strip(it) == 2 * before
    clock.take(it, 0.01, 20)
    assert first_strip(it) == 1 << 18
    clock.take(it, 2 * bands.STRIP_SECONDS, 40)
    assert first_strip(it) == LEAST


def test03_fixed_ones_stay(rgb, monkeypatch):
    clock, it = Clock(monkeypatch), Pace(1 << 13)
    clock.take(it, 0.01, 10)
    assert first_strip(it) == 1 << 13


def test04_the_next_picture_goes_on_with_the_pace_of_the_last(rgb, monkeypatch):
    clock, it = Clock(monkeypatch), Pace()
    before = first_strip(it)
    clock.take(it, 0.01, 4)
    grown = first_strip(it)
    assert grown > before
    # Reading the next scene is no strip's time.
    it.begin()
    clock.take(it, 10 * bands.STRIP_SECONDS)
    clock.take(it, 10 * bands.STRIP_SECONDS)
    assert first_strip(it) == grown
    clock.take(it, 2 * bands.STRIP_SECONDS)
    assert first_strip(it) == grown // 2
