"""Who looks, and where: people of the rays, or the place where most of them were."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import NergError, plain
from nerg_mi.fields.gaze_base import RaySupport
from nerg_mi.maths.geometry import Similarity
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.scene_writer import Eye

RADIUS = 0.5
"""Rays that started within so many metres of each other are counted as of one place."""

FRAMES = 100_000
"""A walk may have so many frames."""

_NAMED = 8


@dataclass(frozen=True)
class Walk:
    """Where somebody was, and looked, at moments of equal distance: ``eyes`` of each frame, at ``times`` (F,) in
    seconds; ``missing``: how many more frames there would be where nothing is known of them."""

    times: np.ndarray
    eyes: list[Eye]
    missing: int


def eye_of_person(rays: Rays, person: str, time: float, gap: float, align: Similarity) -> tuple[Eye, float]:
    """The eye of ``person`` in the place at the ray nearest to ``time`` (seconds), and when that was.

    ``align``: from the rays to the place. Raises `NergError` where there is nobody of that name, and no ray of theirs
    within ``gap`` seconds.
    """
    own = _own(rays, person)
    nearest = own[np.argmin(np.abs(rays.t[own] - time))]
    if abs(rays.t[nearest] - time) > gap:
        raise NergError(_not_then(rays, own, person, f"at {time:g} s", gap))
    (eye,) = _eyes(rays.origin[nearest : nearest + 1], rays.direction[nearest : nearest + 1], align)
    return eye, float(rays.t[nearest])


def walk_of_person(
    rays: Rays, person: str, first: float, last: float, fps: float, gap: float, align: Similarity
) -> Walk:
    """Where ``person`` was from ``first`` to ``last`` (seconds), ``fps`` times a second.

    Positions are linear between two rays, directions the mean of theirs, weighted alike. A moment between two rays
    that are more than ``gap`` seconds apart has no frame, nor has one that is farther than that from the first or the
    last ray. Raises `NergError` where no frame is left.
    """
    if not first < last:
        raise NergError(f"--times is two times, the earlier first, got {first:g},{last:g}")
    if (last - first) * fps > FRAMES:
        raise NergError(
            f"a walk has at most {FRAMES:,} frames, and {last - first:g} s with {fps:g} frames a second have "
            "more; give a smaller --fps, or a shorter time"
        )
    own = _own(rays, person)
    own = own[np.argsort(rays.t[own], kind="stable")]
    times = first + np.arange(int(np.floor((last - first) * fps + 1e-9)) + 1) / fps
    t = rays.t[own]
    after = np.searchsorted(t, times)
    before, after = np.maximum(after - 1, 0), np.minimum(after, len(own) - 1)
    between = t[after] - t[before]
    outside = np.maximum(t[before] - times, times - t[after])
    # A moment of a ray is not between any.
    known = ((between <= gap) & (outside <= gap)) | (t[after] == times)
    if not known.any():
        raise NergError(_not_then(rays, own, person, f"from {first:g} to {last:g} s", gap))
    share = np.clip(np.divide(times - t[before], between, out=np.zeros(len(times)), where=between > 0), 0, 1)[:, None]
    mix = lambda values: values[own[before]] * (1 - share) + values[own[after]] * share
    origin, direction = mix(rays.origin)[known], mix(rays.direction)[known]
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    # Two opposite directions have no mean: that of the nearer ray.
    nearer = np.where(share < 0.5, rays.direction[own[before]], rays.direction[own[after]])[known]
    direction = np.where(length > 1e-3, direction / np.maximum(length, 1e-3), nearer)
    return Walk(times[known], _eyes(origin, direction, align), int(np.sum(~known)))


def support_of_rays(rays: Rays) -> RaySupport:
    """How many rays started where, in metres of their own frame."""
    return RaySupport.of(rays.origin, RADIUS)


def to_place(points: np.ndarray, align: Similarity) -> np.ndarray:
    """Points (..., 3) of the rays' frame in the place's."""
    return np.asarray(points, float) @ align.matrix[:3, :3].T + align.matrix[:3, 3]


def _own(rays: Rays, person: str) -> np.ndarray:
    """Indices of the rays of ``person``."""
    if person not in rays.persons:
        some = ", ".join(plain(name, 40) for name in rays.persons[:_NAMED])
        more = "" if len(rays.persons) <= _NAMED else f" and {len(rays.persons) - _NAMED} more"
        raise NergError(f'nobody in the rays is called "{person}"; they are of {some}{more}')
    own = np.flatnonzero(rays.person == rays.persons.index(person))
    if not len(own):
        raise NergError(f'"{person}" has no rays any more; choose somebody else')
    return own


def _not_then(rays: Rays, own: np.ndarray, person: str, when: str, gap: float) -> str:
    first, last = float(rays.t[own].min()), float(rays.t[own].max())
    return (
        f'there is no ray of "{person}" within {gap:g} s {when}; theirs are from {first:.10g} to {last:.10g} s, and '
        "--gap bridges longer pauses"
    )


def _eyes(origins: np.ndarray, directions: np.ndarray, align: Similarity) -> list[Eye]:
    """Eyes in the place, which look at points a metre away."""
    at, ahead = to_place(origins, align), to_place(origins + directions, align)
    return [Eye(origin, target) for origin, target in zip(at, ahead)]
