"""Generated scenes of boxes whose participants follow known laws of attention: a gallery, an office with windows, a
corridor, a stage.

All shoppers of the demo store follow one law. The participants of these scenes differ: each has an individual
preference for each target. Gaze stays on a target for a while, like a fixation. All data are determined by a seed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)

import numpy as np

Box = tuple[tuple[float, float, float], tuple[float, float, float]]

# Standard deviation of the log preference of a participant, and of the angular error of gaze (radians).
_TASTE, _JITTER = 0.5, np.radians(8.0)
# Probability per sample of a new target: five samples per second, and about 0.6 s per fixation.
NEW_TARGET_PROBABILITY = 0.33
RATE = 5.0
_SPEED = 0.7


def draw_preferences(rng: np.random.Generator, count: int) -> np.ndarray:
    """Preferences (count,) of a participant for each target, factors of its attraction."""
    return np.exp(_TASTE * rng.normal(size=count))


@dataclass(frozen=True)
class Thing:
    """A rectangle that attracts gaze: its centre and half edges (3,) in metres, and its attraction."""

    middle: tuple[float, float, float]
    half: tuple[float, float, float]
    draw: float = 1.0


@dataclass(frozen=True, kw_only=True)
class GeneratedPlace:
    """A scene and a law. The probability of a target is its attraction and the participant's preference, times 1 / (1 +
    (d / falloff)²) and the cosine of the viewing angle, if it is visible; ``ahead`` and ``around`` are attractions of
    the walking direction, and of no target."""

    name: str
    boxes: tuple[Box, ...]
    things: tuple[Thing, ...]
    # Corners (2, 2) of the walkable floor; walls are beyond.
    floor: tuple[tuple[float, float], tuple[float, float]]
    falloff: float = 1e3
    ahead: float = 0.1
    around: float = 0.2
    # Maximum distance in metres from the start of a participant; None: unlimited.
    strays: float | None = None
    seated: bool = False
    free: Callable[[np.ndarray], np.ndarray] = field(default=lambda p: np.ones(len(p), bool))

    def write(self, path: Path) -> Path:
        """The scene as XML, in metres, z up."""
        shape = lambda low, high: (
            '  <shape type="cube"><transform name="to_world">'
            f'<scale x="{(high[0] - low[0]) / 2:g}" y="{(high[1] - low[1]) / 2:g}" z="{(high[2] - low[2]) / 2:g}"/>'
            + '<translate x="{:g}" y="{:g}" z="{:g}"/>'.format(*((a + b) / 2 for a, b in zip(low, high)))
            + "</transform></shape>"
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(
            '<scene version="3.5.0">\n' + "\n".join(shape(low, high) for low, high in self.boxes) + "\n</scene>\n"
        )
        return path

    def record(self, scene: Path, people: int = 16, seconds: float = 240.0, seed: int = 0, targets: list | None = None):
        """Rays of ``people`` participants in ``scene`` (its file), ``seconds`` each. ``targets`` receives, for each
        participant, the weights (N, K) of the targets without preferences, the preferences (K,) and the selected
        targets (N,)."""
        from nerg_mi.tracking.rays import Rays

        import mitsuba as mi

        twin = mi.load_file(str(scene))
        rng = np.random.default_rng(seed)
        count = round(seconds * RATE)
        middles = np.array([t.middle for t in self.things])
        halves = np.array([t.half for t in self.things])
        normals = np.eye(3)[np.argmin(halves, axis=1)]
        draws = np.array([t.draw for t in self.things])
        origins, directions, who, times = [], [], [], []
        for person in range(people):
            p, direction = self._walk(rng, count)
            taste = np.r_[draw_preferences(rng, len(draws)), 1.0, 1.0]
            offset = middles[None] - p[:, None]
            distance = np.linalg.norm(offset, axis=2)
            cosine = np.abs(np.einsum("nkc,kc->nk", offset / distance[..., None], normals))
            seen = self._seen(twin, p, middles)
            weight = draws * cosine * seen / (1 + (distance / self.falloff) ** 2)
            weight = np.concatenate([weight, np.full((count, 1), self.ahead), np.full((count, 1), self.around)], axis=1)
            selected = self._look(rng, weight * taste)
            if targets is not None:
                targets.append((weight, taste, selected))
            d = np.empty((count, 3))
            spot = rng.uniform(-1, 1, (count, 3))
            for i, k in enumerate(selected):
                if k < len(draws):
                    d[i] = middles[k] + 0.8 * spot[i] * halves[k] - p[i]
                elif k == len(draws):
                    d[i] = [*direction[i], -0.15]
                else:
                    d[i] = [*rng.normal(size=2), 0.3 * rng.normal() - 0.15]
            d /= np.linalg.norm(d, axis=1, keepdims=True)
            d += _JITTER * rng.normal(size=d.shape)
            origins.append(p)
            directions.append(d / np.linalg.norm(d, axis=1, keepdims=True))
            who.append(np.full(count, person))
            times.append(np.arange(count) / RATE)
        joined = [np.concatenate(v) for v in (times, who, origins, directions)]
        names = tuple(f"{self.name}-{k:02d}" for k in range(people))
        return Rays(joined[0], joined[1], names, joined[2], joined[3], np.ones(len(joined[0])))

    def _walk(self, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Head positions (count, 3) and walking directions (count, 2) of a participant who walks from point to point
        and pauses there."""
        (low, high), height = np.array(self.floor), rng.normal(1.22 if self.seated else 1.63, 0.07)

        def point(near: np.ndarray | None) -> np.ndarray:
            while True:
                at = rng.uniform(low, high) if near is None else near + self.strays * rng.uniform(-1, 1, 2)
                if np.all((at >= low) & (at <= high)) and self.free(at[None])[0]:
                    return at

        home = point(None) if self.strays is not None else None
        at, goal, rest = point(home), point(home), 0
        heads, variants, direction = np.empty((count, 3)), np.empty((count, 2)), np.array([1.0, 0.0])
        for i in range(count):
            away = goal - at
            far = np.linalg.norm(away)
            if rest:
                rest -= 1
            elif far < _SPEED / RATE:
                goal, rest = point(home), int(rng.integers(5, 40))
            else:
                direction = away / far
                ahead = at + direction * _SPEED / RATE
                if self.free(ahead[None])[0]:
                    at = ahead
                else:
                    goal = point(home)
            heads[i], variants[i] = [*at, height + 0.01 * rng.normal()], direction
        return heads, variants

    def _look(self, rng: np.random.Generator, weight: np.ndarray) -> np.ndarray:
        """Targets (N,), held for a while, drawn with probabilities (N, K)."""
        drawn = (np.cumsum(weight, axis=1) / weight.sum(axis=1, keepdims=True) < rng.random((len(weight), 1))).sum(
            axis=1
        )
        new, out = rng.random(len(weight)) < NEW_TARGET_PROBABILITY, drawn.copy()
        for i in range(1, len(out)):
            # A target that is no longer visible is dropped.
            if not new[i] and weight[i, out[i - 1]] > 0:
                out[i] = out[i - 1]
        return out

    @staticmethod
    def _seen(twin, p: np.ndarray, middles: np.ndarray) -> np.ndarray:
        """Whether targets are unoccluded (N, K); a target does not occlude itself."""
        from nerg_mi.maths.arrays import to_vector

        import mitsuba as mi

        a, b = np.repeat(p, len(middles), axis=0), np.tile(middles, (len(p), 1))
        direction = b - a
        ray = mi.Ray3f(to_vector(mi.Point3f, a), to_vector(mi.Vector3f, direction))
        ray.maxt = mi.Float(0.97)
        return ~np.array(twin.ray_test(ray)).reshape(len(p), len(middles))


def _walls(x: float, y: float, z: float, thick: float = 0.1) -> list[Box]:
    return [
        ((-thick, -thick, -thick), (x + thick, y + thick, 0)),
        ((-thick, -thick, z), (x + thick, y + thick, z + thick)),
        ((-thick, 0, 0), (0, y, z)),
        ((x, 0, 0), (x + thick, y, z)),
        ((0, -thick, 0), (x, 0, z)),
        ((0, y, 0), (x, y + thick, z)),
    ]


def _gallery() -> GeneratedPlace:
    """Pictures on the walls and on a partition that hides half of the room; distance has no effect."""
    boxes = [*_walls(10, 8, 3.5), ((4.9, 2, 0), (5.1, 6, 3)), ((2, 6.4, 0), (2.5, 6.9, 1.1))]
    shapes = [Thing((x, 0.02, 1.6), (0.5, 0.01, 0.4), d) for x, d in ((1.5, 1.0), (4, 0.6), (6.5, 2.0), (8.8, 0.5))]
    shapes += [Thing((x, 7.98, 1.6), (0.4, 0.01, 0.6), d) for x, d in ((1.2, 0.8), (4.2, 1.5), (7.5, 1.0))]
    shapes += [Thing((4.88, 4, 1.6), (0.01, 0.9, 0.6), 2.5), Thing((5.12, 4, 1.6), (0.01, 0.5, 0.7), 1.2)]
    shapes += [Thing((9.98, 4, 1.6), (0.01, 1.0, 0.6), 1.5), Thing((2.25, 6.65, 1.3), (0.2, 0.15, 0.2), 1.2)]
    free = lambda p: (
        ~(
            ((np.abs(p[:, 0] - 5) < 0.45) & (p[:, 1] > 1.6) & (p[:, 1] < 6.4))
            | ((np.abs(p[:, 0] - 2.25) < 0.6) & (np.abs(p[:, 1] - 6.65) < 0.6))
        )
    )
    return GeneratedPlace(
        name="generated-gallery",
        boxes=tuple(boxes),
        things=tuple(shapes),
        floor=((0.6, 0.6), (9.4, 7.4)),
        falloff=4.0,
        free=free,
    )


def _office() -> GeneratedPlace:
    """Near desks with screens, and two windows without glass, through which rays escape."""
    boxes = [box for box in _walls(9, 6, 2.8) if box[0] != (0, 6, 0)]
    # The wall with the windows, in pieces around them.
    boxes += [((0, 6, 0), (9, 6.1, 0.9)), ((0, 6, 2.3), (9, 6.1, 2.8))]
    boxes += [((a, 6, 0.9), (b, 6.1, 2.3)) for a, b in ((0, 1), (3.5, 5.5), (8, 9))]
    shapes = [Thing((2.25, 6.05, 1.6), (1.2, 0.01, 0.6), 0.7), Thing((6.75, 6.05, 1.6), (1.2, 0.01, 0.6), 0.7)]
    spots = [(x, y) for x in (1.5, 4.5, 7.5) for y in (1.6, 3.8)]
    for x, y in spots:
        boxes.append(((x - 0.8, y - 0.4, 0.7), (x + 0.8, y + 0.4, 0.75)))
        boxes.append(((x - 0.3, y - 0.05, 0.8), (x + 0.3, y, 1.2)))
        shapes.append(Thing((x, y - 0.07, 1.0), (0.28, 0.01, 0.18), 3.0))
    shapes.append(Thing((8.98, 3, 1.5), (0.01, 0.6, 0.45), 0.8))
    desks = lambda p: np.any(
        [(np.abs(p[:, 0] - x) < 0.85) & (p[:, 1] > y - 0.45) & (p[:, 1] < y + 0.45) for x, y in spots], axis=0
    )
    return GeneratedPlace(
        name="generated-office",
        boxes=tuple(boxes),
        things=tuple(shapes),
        floor=((0.4, 0.4), (8.6, 5.6)),
        falloff=1.5,
        strays=1.2,
        seated=True,
        free=lambda p: ~desks(p),
    )


def _corridor() -> GeneratedPlace:
    """A corridor of twenty metres with a few doors and posters: most gaze is straight ahead."""
    shapes = [Thing((x, 0.02, 1.4), (0.4, 0.01, 0.5), d) for x, d in ((3, 0.6), (8, 0.3), (15, 0.9))]
    shapes += [Thing((x, 1.98, 1.5), (0.4, 0.01, 0.5), d) for x, d in ((5, 0.4), (12, 0.8))]
    shapes.append(Thing((19.98, 1, 1.6), (0.01, 0.6, 0.7), 1.5))
    return GeneratedPlace(
        name="generated-corridor",
        boxes=tuple(_walls(20, 2, 2.6)),
        things=tuple(shapes),
        floor=((0.5, 0.5), (19.5, 1.5)),
        falloff=2.5,
        ahead=0.8,
    )


def _stage() -> GeneratedPlace:
    """Rows of seats in front of a stage: everybody looks far ahead, and hardly moves."""
    boxes = [*_walls(12, 16, 6), ((2, 0.5, 0), (10, 4, 1.0)), ((5.7, 2, 1.0), (6.3, 2.4, 2.1))]
    boxes += [((1, y, 0), (11, y + 0.1, 0.9)) for y in (7.6, 9.0, 10.4, 11.8, 13.2)]
    shapes = [Thing((6, 2.2, 2.3), (0.5, 0.2, 0.4), 4.0), Thing((3.4, 2, 2.0), (0.5, 0.3, 0.8), 1.5)]
    shapes += [Thing((8.8, 2.4, 2.0), (0.5, 0.3, 0.8), 1.0), Thing((6, 0.02, 4.3), (2.5, 0.01, 1.0), 1.2)]
    return GeneratedPlace(
        name="generated-stage",
        boxes=tuple(boxes),
        things=tuple(shapes),
        floor=((1.2, 7.0), (10.8, 14.5)),
        strays=0.3,
        seated=True,
        around=0.3,
    )


PLACES: Sequence[Callable[[], GeneratedPlace]] = (_gallery, _office, _corridor, _stage)
