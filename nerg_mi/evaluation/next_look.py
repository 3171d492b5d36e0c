"""The next look of a participant: its density over directions, given earlier looks, the elapsed time and a gaze field.

p(d) = Σ_c w_c(τ) p_c(d) in 1/sr. The weights depend on the time τ since the last look. A component p_c is either

    p_c(d) ∝ F(d)^f exp(κ_last l·d + κ_heading h·d),

with the direction l of the last look, the gaze field F at the current position (f is 0 or 1), and the walking direction
h of length min(1, speed / 0.5 m/s); or F(d)^f times the mean of von Mises-Fisher kernels around looks before the last
one. With f = 0, narrow kernels describe a look that stays, and wide ones a saccade. With f = 1, a saccade goes to one
of the directions that the field predicts, preferably near the last look, ahead, or near an earlier look. A look at a
known surface point is aimed at this point from the current position.

The shapes of the components are fixed, and kernels of several widths are included, so that only the weights are fitted.
They are piecewise linear in log τ, and maximise the likelihood by expectation maximisation (Dempster et al. 1977). The
log likelihood is concave in the weights: there are no local maxima.

Where heads are tracked and eyes are not, the mean gaze direction of a head takes the place of the last look, at the
same time (`PastLooks.from_heads`).
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import product
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.maths import vmf
from nerg_mi.maths.sphere import aim, fibonacci_directions, sample_uniform_directions
from nerg_mi.tracking.direction_checks import compute_head_frames
from nerg_mi.tracking.filters import find_sessions
from nerg_mi.tracking.probes import compute_participant_weights
from nerg_mi.tracking.rays import Rays

from .baselines import MIN_AIM_DISTANCE, UNIFORM_DENSITY
from .gaze import EPS

RayDensity = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Density (N,) in 1/sr of rays with origins (N, 3) and directions (N, 3), such as the ``density`` of a `GazeField`."""

RayDistance = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Distance (N,) in metres to the surface along rays with origins (N, 3) and directions (N, 3); not finite: none."""

GRID_DIRECTIONS = 1024
"""Directions of equal area in which the field is evaluated for products; they resolve kernels up to κ = 64."""

EARLIER_LOOKS, EARLIER_INTERVAL = 120, 0.5
"""Number of looks before the last one that a participant may return to, and the seconds between them."""

_WALKING_SPEED = 0.5  # m/s; a slower displacement is a less certain walking direction
_BLOCK = 128  # looks whose kernels on the grid are held at the same time


# ---- Looks and what precedes them ----


@dataclass(frozen=True, eq=False)
class PastLooks:
    """What precedes each of N looks, in the frame of the rays.

    Attributes
    ----------
    origin
        Current positions (N, 3) in metres.
    elapsed
        Seconds (N,) since the last look.
    last
        Unit directions (N, 3) of the last look.
    heading
        Walking directions (N, 3), horizontal, of length min(1, speed / 0.5 m/s) (`find_heading`).
    earlier
        Unit directions (N, H, 3) of looks before the last one; NaN where there are none.
    """

    origin: np.ndarray
    elapsed: np.ndarray
    last: np.ndarray
    heading: np.ndarray
    earlier: np.ndarray

    def __len__(self) -> int:
        return len(self.origin)

    def select(self, rows: slice | np.ndarray) -> PastLooks:
        """Select looks by a slice, an index or a mask."""
        return PastLooks(*(getattr(self, f.name)[rows] for f in fields(self)))

    @classmethod
    def from_heads(cls, origin: np.ndarray, head: np.ndarray, gaze_in_head: np.ndarray) -> PastLooks:
        """Take the mean gaze direction of each head as the last look, without walking directions and earlier looks.

        Parameters
        ----------
        origin, head : numpy.ndarray
            Positions (N, 3) in metres, and unit directions (N, 3) of the heads.
        gaze_in_head : numpy.ndarray
            Mean direction (3,) of gaze in the head's frame (`measure_gaze_in_head`).
        """
        look = np.einsum("nij,i->nj", compute_head_frames(np.asarray(head, np.float64)), gaze_in_head)
        nothing = np.empty((len(look), 0, 3))
        return cls(np.asarray(origin, np.float64), np.ones(len(look)), look, np.zeros_like(look), nothing)

    @classmethod
    def concatenate(cls, parts: Sequence[PastLooks]) -> PastLooks:
        """Concatenate what precedes several sets of looks."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))


def find_past_looks(
    rays: Rays,
    rows: np.ndarray,
    elapsed: float,
    *,
    earlier: int = EARLIER_LOOKS,
    interval: float = EARLIER_INTERVAL,
    tolerance: float = 0.2,
    distance: RayDistance | None = None,
) -> tuple[PastLooks, np.ndarray]:
    """Find the looks that precede some rays in the same recording.

    Parameters
    ----------
    rays : Rays
        All rays of the participants.
    rows : numpy.ndarray
        Indices (N,) of the rays that are predicted.
    elapsed : float
        Seconds between the last look and the predicted ray.
    earlier, interval : int, float
        Number of looks before the last one, and seconds between them.
    tolerance : float
        Maximum deviation of the elapsed time, as a fraction of it.
    distance : callable, optional
        Traces rays without a recorded hit point. Without it they keep their direction.

    Returns
    -------
    past : PastLooks
        What precedes those of the rays that have a last look.
    rows : numpy.ndarray
        Indices of these rays.
    """
    sessions = find_sessions(rays)
    order = np.arange(len(rays)) if sessions.order is None else sessions.order
    label = sessions.label_rays()
    t = rays.t[order] - rays.t[order][sessions.starts[:-1]][label]
    # One clock for all recordings, with pauses in which no look is found.
    pause = t.max() + 2 * (elapsed + (earlier + 1) * interval)
    clock = np.maximum.accumulate(t + pause * label)
    now = np.empty(len(rays))
    now[order] = clock
    now = now[rows]

    def find_ray(age: float) -> tuple[np.ndarray, np.ndarray]:
        """Rays nearest in time to ``age`` seconds before, and their deviations in seconds."""
        after = np.clip(np.searchsorted(clock, now - age), 1, len(clock) - 1)
        nearest = after - (now - age - clock[after - 1] < clock[after] - now + age)
        return order[nearest], np.abs(clock[nearest] - now + age)

    looks, deviation = (
        np.stack(v, axis=1) for v in zip(*(find_ray(elapsed + k * interval) for k in range(earlier + 1)))
    )
    actual = rays.t[rows] - rays.t[looks[:, 0]]
    # Samples that share their time with the predicted one do not precede it.
    has_last = (deviation[:, 0] <= tolerance * elapsed) & (actual > 0)
    is_look = deviation[has_last] <= 0.5 * interval
    is_look[:, 0] = True
    looks = looks[has_last]
    rows, actual = rows[has_last], actual[has_last]
    origin = rays.origin[rows]
    used, index = np.unique(looks, return_inverse=True)
    points = _find_points(rays, used, distance)[index.reshape(looks.shape)]
    directions = aim(points, rays.direction[looks], origin[:, None], MIN_AIM_DISTANCE)
    directions = np.where(is_look[..., None], directions, np.nan)
    heading = find_heading(origin - rays.origin[looks[:, 0]], actual)
    return PastLooks(origin, actual, directions[:, 0], heading, directions[:, 1:]), rows


def _find_points(rays: Rays, rows: np.ndarray, distance: RayDistance | None) -> np.ndarray:
    """Surface points (N, 3) of the rays ``rows`` (N,): recorded, else traced, else NaN."""
    points = np.full((len(rows), 3), np.nan) if rays.hit is None else np.array(rays.hit[rows], float)
    unknown = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if distance is not None and len(unknown):
        points[unknown] = _trace(distance, rays.origin[rows[unknown]], rays.direction[rows[unknown]])
    return points


def _trace(distance: RayDistance, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Surface points (N, 3) along rays; NaN where there is none."""
    length = np.asarray(distance(origins, directions))
    return origins + np.where(np.isfinite(length), length, np.nan)[:, None] * directions


def find_heading(displacement: np.ndarray, elapsed: np.ndarray) -> np.ndarray:
    """Walking directions (N, 3), horizontal, of length min(1, speed / 0.5 m/s), from displacements (N, 3) in metres
    and their durations (N,) in seconds."""
    velocity = displacement * [1.0, 1.0, 0.0] / np.asarray(elapsed)[:, None]
    return velocity / np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), _WALKING_SPEED)


def measure_gaze_in_head(rays: Rays) -> np.ndarray:
    """Measure the mean direction (3,) of gaze in the frame (ahead, right, up) of heads without roll. Participants have
    equal weights. Raises `NergError` if no ray has a head direction.
    """
    if not (has_head := find_heads(rays)).any():
        raise NergError("the rays have no directions of heads; import them with a reader or column map that names head")
    rays = rays.select(has_head)
    in_head = np.einsum("nij,nj->ni", compute_head_frames(np.asarray(rays.head, np.float64)), rays.direction)
    mean = compute_participant_weights(rays) @ in_head
    return mean / np.linalg.norm(mean)


def find_heads(rays: Rays) -> np.ndarray:
    """Find the rays with a head direction: mask (N,)."""
    return np.zeros(len(rays), bool) if rays.head is None else np.isfinite(rays.head[:, 0])


# ---- Components ----


@dataclass(frozen=True)
class Component:
    """A density of fixed shape: whether it is a product with the field, and concentrations κ of its kernels."""

    field: bool = False
    last: float = 0.0
    heading: float = 0.0
    # Kernels around earlier looks; excludes the other two.
    earlier: float = 0.0

    def __str__(self) -> str:
        names = [f"{name} {value:g}" for name, value in asdict(self).items() if name != "field" and value]
        return " x ".join([*(["field"] if self.field else []), *names]) or "uniform"

    def kernel(self, past: PastLooks, directions: np.ndarray) -> np.ndarray:
        """Density (N, D) in 1/sr without the field, in unit ``directions`` (D, 3) or (N, D, 3)."""
        if not self.earlier:
            return _evaluate_vmf(self.last * past.last + self.heading * past.heading, directions)
        is_look = np.isfinite(past.earlier[..., 0])
        density = np.zeros((len(past), directions.shape[-2]))
        for look, mask in zip(np.moveaxis(past.earlier, 1, 0), is_look.T):
            density += mask[:, None] * _evaluate_vmf(self.earlier * np.where(mask[:, None], look, 0), directions)
        count = is_look.sum(axis=1)[:, None]
        return np.where(count > 0, density / np.maximum(count, 1), UNIFORM_DENSITY)

    def draw(self, past: PastLooks, rng: np.random.Generator) -> np.ndarray:
        """Draw a direction (3,) from the kernel without the field, given what precedes one look."""
        eta = self.last * past.last[0] + self.heading * past.heading[0]
        looks = past.earlier[0][np.isfinite(past.earlier[0, :, 0])]
        if self.earlier and len(looks):
            eta = self.earlier * looks[rng.integers(len(looks))]
        kappa = float(np.linalg.norm(eta))
        return vmf.sample(eta / kappa, kappa, rng) if kappa else sample_uniform_directions(1, rng)[0]


def _evaluate_vmf(eta: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Densities (N, D) of von Mises-Fisher distributions with natural parameters ``eta`` (N, 3), of length κ."""
    kappa = np.linalg.norm(eta, axis=1)
    cosine = eta @ directions.T if directions.ndim == 2 else np.einsum("ni,nki->nk", eta, directions)
    return np.exp(cosine + (vmf.log_normaliser(kappa) - kappa)[:, None])


FIELD = Component(True)
"""The gaze field alone."""
LAST_LOOK = (Component(), *(Component(last=k) for k in (4, 16, 64, 256, 1024)))
"""A uniform floor, and kernels around the last look."""
MIXTURE = (*LAST_LOOK, FIELD, *(Component(earlier=k) for k in (4, 16, 64)))
"""Components without products."""
COMPONENTS = (
    *MIXTURE,
    *(Component(True, *kappas) for kappas in product((0, 1, 4, 16, 64), (0, 1, 4, 16)) if any(kappas)),
    *(Component(True, earlier=k) for k in (4, 16, 64)),
)
"""All components."""
HEAD = (Component(), *(Component(last=k) for k in (8, 16, 32, 64, 128, 256)))
"""A uniform floor, and kernels around the mean gaze direction of the head."""
HEAD_COMPONENTS = (*HEAD, FIELD, *(Component(True, k) for k in (4, 8, 16, 32, 64)))
"""All components given the head."""


def evaluate_components(
    components: Sequence[Component],
    past: PastLooks,
    directions: np.ndarray,
    field_density: np.ndarray,
    field_on_grid: np.ndarray,
) -> np.ndarray:
    """Evaluate components in some directions.

    Parameters
    ----------
    components : sequence of Component
        C components.
    past : PastLooks
        What precedes N looks.
    directions : numpy.ndarray
        Unit directions (N, D, 3).
    field_density : numpy.ndarray
        Density (N, D) of the field in these directions.
    field_on_grid : numpy.ndarray
        Density (N, S) of the field in S `fibonacci_directions`, by whose mean it is normalised.

    Returns
    -------
    numpy.ndarray
        Densities (N, D, C) in 1/sr.
    """
    grid = fibonacci_directions(field_on_grid.shape[1])
    out = np.empty((len(past), directions.shape[1], len(components)))
    for start in range(0, len(past), _BLOCK):
        rows = slice(start, start + _BLOCK)
        block = past.select(rows)
        on_grid, scale = _normalise(field_on_grid[rows])
        field = field_density[rows] / scale + EPS * UNIFORM_DENSITY
        for k, component in enumerate(components):
            density = component.kernel(block, directions[rows])
            if component.field:
                integral = 4 * np.pi * (on_grid * component.kernel(block, grid)).mean(axis=1, keepdims=True)
                density = density * field / integral
            out[rows, :, k] = density
    return out


def _normalise(on_grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Densities (N, S) on the grid divided by their integrals (N, 1), with a small floor, and these integrals."""
    scale = 4 * np.pi * on_grid.mean(axis=1, keepdims=True, dtype=np.float64)
    # Products are defined everywhere, also for a field that is zero around the last look.
    return on_grid / scale + EPS * UNIFORM_DENSITY, scale


def evaluate_on_grid(field: RayDensity, origins: np.ndarray, count: int = GRID_DIRECTIONS) -> np.ndarray:
    """Densities (N, S) of the field at ``origins`` (N, 3) in ``count`` `fibonacci_directions`."""
    grid = fibonacci_directions(count)
    directions = np.broadcast_to(grid, (len(origins), *grid.shape)).reshape(-1, 3)
    return np.asarray(field(np.repeat(origins, count, axis=0), directions)).reshape(len(origins), count)


# ---- The model ----


@dataclass(frozen=True, eq=False)
class NextLook:
    """Density of the next look, and its simulation.

    Attributes
    ----------
    components
        C components.
    knots
        Elapsed times (B,) in seconds, increasing, at which weights are given.
    weights
        Weights (B, C); each row sums to one.
    gaze_in_head
        Mean direction (3,) of gaze in the head, if the head takes the place of the last look (`PastLooks.from_heads`);
        None otherwise.
    """

    components: tuple[Component, ...]
    knots: np.ndarray
    weights: np.ndarray
    gaze_in_head: np.ndarray | None = None

    def weights_at(self, elapsed: np.ndarray) -> np.ndarray:
        """Weights (N, C) after ``elapsed`` (N,) seconds, constant outside of the knots."""
        return interpolation_weights(self.knots, elapsed) @ self.weights

    def density(self, past: PastLooks, directions: np.ndarray, field: RayDensity) -> np.ndarray:
        """Density of the next look.

        Parameters
        ----------
        past : PastLooks
            What precedes N looks.
        directions : numpy.ndarray
            Unit directions (D, 3) or (N, D, 3).
        field : callable
            The gaze field: density (M,) of rays with origins (M, 3) and directions (M, 3).

        Returns
        -------
        numpy.ndarray
            Densities (N, D) in 1/sr.
        """
        directions = np.broadcast_to(directions, (len(past), *np.shape(directions)[-2:]))
        origins = np.repeat(past.origin, directions.shape[1], axis=0)
        density = np.asarray(field(origins, directions.reshape(-1, 3))).reshape(directions.shape[:2])
        on_grid = evaluate_on_grid(field, past.origin)
        parts = evaluate_components(self.components, past, directions, density, on_grid)
        return np.einsum("nkc,nc->nk", parts, self.weights_at(past.elapsed))

    def sample(
        self,
        times: np.ndarray,
        positions: np.ndarray,
        field: RayDensity,
        *,
        seed: int = 0,
        earlier: int = EARLIER_LOOKS,
        interval: float = EARLIER_INTERVAL,
        distance: RayDistance | None = None,
    ) -> np.ndarray:
        """Simulate the looks of a participant along a trajectory.

        Each look is drawn from the density given the look before it. The first is drawn from the field.

        Parameters
        ----------
        times : numpy.ndarray
            Times (T,) of the looks in seconds, increasing.
        positions : numpy.ndarray
            Positions (T, 3) of the eye in metres.
        field : callable
            The gaze field, as for `density`.
        seed : int
            Seed of the random numbers.
        earlier, interval : int, float
            Number of looks before the last one that are returned to, and the minimum of the seconds between them.
        distance : callable, optional
            Distance to the surface along rays. With it, a look stays at its surface point while the position changes.

        Returns
        -------
        numpy.ndarray
            Unit directions (T, 3).

        Raises
        ------
        NergError
            If the times do not increase, or the model is one given the head.
        """
        if self.gaze_in_head is not None:
            raise NergError(
                f"this model predicts gaze from heads and simulates no looks; fit one without {parameter('head', True)}"
            )
        times, positions = np.asarray(times, float), np.asarray(positions, float)
        if len(times) != len(positions) or not (np.diff(times) > 0).all():
            raise NergError(
                f"{len(positions)} positions and {len(times)} times: looks need increasing times, one for each position"
            )
        rng, grid = np.random.default_rng(seed), fibonacci_directions(GRID_DIRECTIONS)
        on_grid, _ = _normalise(evaluate_on_grid(field, positions))
        steps = np.diff(times)
        heading, weights = find_heading(np.diff(positions, axis=0), steps), self.weights_at(steps)
        directions, points = np.empty_like(positions), np.full_like(positions, np.nan)
        spaced: list[int] = []
        nothing = np.zeros_like(positions)
        start = PastLooks(positions, np.ones(len(times)), nothing, nothing, np.empty((len(times), 0, 3)))
        for t, position in enumerate(positions):
            component, past = FIELD, start.select(slice(t, t + 1))
            if t:
                # As in the fit: the looks are an interval apart, and that long before the last one.
                count = bisect_right(spaced, times[t - 1] - interval, key=times.__getitem__)
                looks = [t - 1, *spaced[max(0, count - earlier) : count]]
                aimed = aim(points[looks], directions[looks], position, MIN_AIM_DISTANCE)
                past = PastLooks(position[None], steps[t - 1 : t], aimed[:1], heading[t - 1 : t], aimed[None, 1:])
                component = self.components[rng.choice(len(self.components), p=weights[t - 1])]
                if not spaced or times[t - 1] - times[spaced[-1]] >= interval:
                    spaced.append(t - 1)
            if component.field:
                mass = on_grid[t] * component.kernel(past, grid)[0]
                # A cell of the grid, and within it a kernel of the same standard deviation.
                cell = rng.choice(len(grid), p=mass / mass.sum())
                directions[t] = vmf.sample(grid[cell], 3 / np.pi * len(grid), rng)
            else:
                directions[t] = component.draw(past, rng)
            if distance is not None:
                points[t] = _trace(distance, position[None], directions[t : t + 1])[0]
        return directions

    def to_json(self) -> dict[str, Any]:
        """JSON object, which `from_json` reads."""
        return {
            "components": [asdict(c) for c in self.components],
            "elapsed": self.knots.tolist(),
            "weights": self.weights.tolist(),
            "gaze_in_head": None if self.gaze_in_head is None else self.gaze_in_head.tolist(),
        }

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> NextLook:
        """Read the object of `to_json`."""
        components = tuple(Component(**c) for c in document["components"])
        # Files of earlier versions do not have it.
        in_head = document.get("gaze_in_head")
        in_head = None if in_head is None else np.array(in_head)
        return cls(components, np.array(document["elapsed"]), np.array(document["weights"]), in_head)


def interpolation_weights(knots: np.ndarray, elapsed: np.ndarray) -> np.ndarray:
    """Weights (N, B) of linear interpolation between ``knots`` (B,) in the logarithm of ``elapsed`` (N,)."""
    knots, elapsed = np.asarray(knots, float), np.asarray(elapsed, float)
    return np.stack([np.interp(np.log(elapsed), np.log(knots), row) for row in np.eye(len(knots))], axis=1)


def fit_next_look(
    components: Sequence[Component],
    densities: np.ndarray,
    elapsed: np.ndarray,
    knots: Sequence[float],
    iterations: int = 300,
) -> NextLook:
    """Fit the weights by maximum likelihood.

    Parameters
    ----------
    components : sequence of Component
        C components.
    densities : numpy.ndarray
        Their densities (N, C) at the observed looks (`evaluate_components`).
    elapsed : numpy.ndarray
        Seconds (N,) since the last look.
    knots : sequence of float
        Elapsed times in seconds, increasing.
    iterations : int
        Maximum number of iterations. Expectation maximisation ends when the mean log likelihood increases by less than
        1e-6.

    Returns
    -------
    NextLook
        The model.

    Raises
    ------
    NergError
        If no look determines the weights at a knot.
    """
    times = np.asarray(knots, float)
    shape = interpolation_weights(times, elapsed)
    if not shape.any(axis=0).all():
        raise NergError(
            f"no look has another one about {times[~shape.any(axis=0)][0]:g} s before; change {parameter('elapsed')}"
        )
    weights = np.full((len(times), len(components)), 1 / len(components))
    previous = -np.inf
    for _ in range(iterations):
        likelihood = np.einsum("nc,nc->n", shape @ weights, densities)
        weights = weights * (shape.T @ (densities / likelihood[:, None]))
        weights /= weights.sum(axis=1, keepdims=True)
        level = np.log(likelihood).mean()
        if level - previous < 1e-6:
            break
        previous = level
    return NextLook(tuple(components), times, weights)


# ---- Scores ----


@dataclass(frozen=True, eq=False)
class LookSample:
    """N looks with what precedes them, and the densities that are compared at them."""

    past: PastLooks
    direction: np.ndarray  # Unit directions (N, 3) of the looks
    person: np.ndarray  # Participants (N,)
    knot: np.ndarray  # Index (N,) of the elapsed time
    zone: np.ndarray  # Zone (N,) of held-out positions
    field: tuple[np.ndarray, np.ndarray]  # Gaze field: densities (N,) at the looks and (N, S) on the grid
    prior: tuple[np.ndarray, np.ndarray]  # Position-independent prior: (N,) and (N, S)

    def evaluate(self, components: Sequence[Component], factor: str) -> np.ndarray:
        """Densities (N, C) of ``components`` at the looks; ``factor``, "field" or "prior", is what products contain."""
        density, on_grid = getattr(self, factor)
        return evaluate_components(components, self.past, self.direction[:, None], density[:, None], on_grid)[:, 0]


NEXT_LOOK = "next look"
Methods = Mapping[str, tuple[Sequence[Component], str]]
"""Components of each method, and the density that takes the place of the field. The first method has all components,
and the field."""
METHODS: Methods = {
    NEXT_LOOK: (COMPONENTS, "field"),
    "next look without products": (MIXTURE, "field"),
    "next look without heading": ([c for c in COMPONENTS if not c.heading], "field"),
    "next look with the prior as field": (COMPONENTS, "prior"),
    "last look": ((*LAST_LOOK, FIELD), "prior"),
    "gaze field": ((FIELD,), "field"),
}
"""Methods given the last looks. The last look alone includes the position-independent prior."""
HEAD_METHODS: Methods = {
    "head and field": (HEAD_COMPONENTS, "field"),
    "head and prior": (HEAD_COMPONENTS, "prior"),
    "head": (HEAD, "prior"),
    "gaze field": ((FIELD,), "field"),
}
"""Methods given the head."""


def score_next_look(
    train: LookSample,
    test: LookSample,
    knots: Sequence[float],
    resamples: int = 200,
    seed: int = 0,
    methods: Methods = METHODS,
) -> tuple[NextLook, list[dict[str, Any]]]:
    """Fit the methods to some looks, and score them on others.

    Parameters
    ----------
    train, test : LookSample
        Looks that determine the weights, and looks of other participants. For scores in a zone, the weights are fitted
        in the other zones, if there are any: how far a field is to be trusted differs from zone to zone.
    knots : sequence of float
        Elapsed times in seconds.
    resamples : int
        Number of bootstrap resamples of the participants. With fewer than three there are no intervals.
    seed : int
        Seed of the bootstrap.
    methods : mapping
        `METHODS`, or `HEAD_METHODS` for looks given the head.

    Returns
    -------
    model : NextLook
        The model of the first method, fitted in all zones.
    rows : list of dict
        A row for each elapsed time and method: the information gain ``bits`` per look over the position-independent
        prior and, except for the first method, ``gap``, the gain of the first method over this one. Both have 95 %
        intervals (± 1.96 standard errors), which treat participants as the sampling unit.
    """
    gains = {name: np.empty(len(test.person)) for name in methods}
    first, (all_components, _) = next(iter(methods.items()))
    densities = {
        factor: [sample.evaluate(all_components, factor) for sample in (train, test)] for factor in ("field", "prior")
    }
    is_crossed = len(np.unique(train.zone)) > 1
    for zone in np.unique(test.zone):
        fitted, scored = (train.zone != zone) | (not is_crossed), test.zone == zone
        for name, (components, factor) in methods.items():
            columns = [all_components.index(component) for component in components]
            observed, predicted = (values[:, columns] for values in densities[factor])
            model = fit_next_look(components, observed[fitted], train.past.elapsed[fitted], knots)
            density = np.einsum("nc,nc->n", predicted, model.weights_at(test.past.elapsed))
            gains[name][scored] = np.log2(density / test.prior[0])[scored]
    people, person = np.unique(test.person, return_inverse=True)
    rng, rows = np.random.default_rng(seed), []
    times = rng.multinomial(len(people), np.full(len(people), 1 / len(people)), resamples)
    for k, elapsed in enumerate(knots):
        mask = test.knot == k
        counts = np.bincount(person[mask], minlength=len(people))
        for name, gain in gains.items():
            row: dict[str, Any] = {"elapsed": float(elapsed), "method": name, "looks": int(mask.sum())}
            scores = {"bits": gain} | ({} if name == first else {"gap": gains[first] - gain})
            for key, values in scores.items():
                row[key] = float(values[mask].mean())
                if len(people) >= 3 and resamples:
                    sums, total = times @ np.bincount(person[mask], values[mask], len(people)), times @ counts
                    half_width = 1.96 * float(np.std(sums[total > 0] / total[total > 0]))
                    row |= {f"{key}.low": row[key] - half_width, f"{key}.high": row[key] + half_width}
            rows.append(row)
    return fit_next_look(all_components, densities["field"][0], train.past.elapsed, knots), rows
