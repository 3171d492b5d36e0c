"""Scores of a gaze field at held-out positions, and the baselines that it is compared with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import AnyGazeField
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.maths.types import variant_types
from nerg_mi.probes.kde import Backend, SphericalKde
from nerg_mi.probes.probes import Probes, place_probes
from nerg_mi.rays.filters import purge, split_by_person
from nerg_mi.rays.rays import Rays
from nerg_mi.train.gaze_data import SURFACE_OPACITY
from nerg_mi.transport.geometry import SceneGeometry, default_march_settings
from nerg_mi.transport.observer import ObserverSettings
from nerg_mi.transport.observer_gaze import ObservedGaze, GazeFieldInstance

from . import metrics

# ---- Baselines ----
#
# What a gaze field must beat: densities without a field.
#
# Each baseline is a function ``(positions (P, 3), directions) -> (P, D)`` of densities in 1/sr that integrate to one;
# ``directions`` is (D, 3) for all positions or (P, D, 3). All share the kernels of :mod:`nerg_mi.probes.kde`.

Baseline = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Densities (P, D), 1/sr, of positions (P, 3) in directions (D, 3) or (P, D, 3)."""

UNIFORM_DENSITY = 1.0 / (4.0 * np.pi)  # 1/sr
# Points in a leaf of a KD-tree, which decides the order of those that are equally far, and so the last bits of sums.
_LEAF = 16


class CachedBaseline:
    """A function of positions and directions that is not asked twice for the same two arrays: its answers are kept, and
    cannot be written to. Neither may the arrays change."""

    def __init__(self, method: Baseline):
        self._method = method
        self._answers: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def __call__(self, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        for p, d, answer in self._answers:
            if p is positions and d is directions:
                return answer
        answer = np.asarray(self._method(positions, directions))
        answer.setflags(write=False)
        self._answers.append((positions, directions, answer))
        return answer


def make_uniform_baseline() -> Baseline:
    """The density that knows nothing: 1/(4π) everywhere."""

    def evaluate(positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        return np.full((len(np.atleast_2d(positions)), np.shape(directions)[-2]), UNIFORM_DENSITY)

    return evaluate


def make_position_blind_baseline(rays: Rays, *, kappa: float = 50.0, backend: Backend = None) -> Baseline:
    """One density for all positions: the KDE of all training rays, with ``kappa``
    (what people look at wherever they stand)."""
    # Runs of rays are separate mixtures averaged in float64: one sum of 10^5
    # terms in float32 would lose digits, and a lane alone would take it all.
    runs = np.array_split(np.arange(len(rays)), max(1, len(rays) // 4096))
    offsets = np.concatenate([[0], np.cumsum([len(r) for r in runs])])
    kde = SphericalKde(rays.direction, offsets, kappa, backend=backend)
    share = np.diff(offsets) / len(rays)

    def evaluate(positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        P = len(np.atleast_2d(positions))
        directions = np.asarray(directions)
        density = share @ kde.evaluate(directions.reshape(-1, 3)).astype(np.float64)
        return np.broadcast_to(density, (P, len(density))) if directions.ndim == 2 else density.reshape(P, -1)

    return evaluate


def make_nearest_probes_baseline(probes: Probes, k: int = 16, *, backend: Backend = None) -> Baseline:
    """Mean density of the ``k`` training probes nearest to a position; k = 1 is
    the nearest probe. Fewer where there are fewer probes."""
    from scipy.spatial import KDTree

    tree = KDTree(probes.positions, leafsize=_LEAF)
    k = min(k, len(probes))
    rays = [np.arange(a, b) for a, b in zip(probes.offsets[:-1], probes.offsets[1:])]

    def evaluate(positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        found = _nearest(tree, np.atleast_2d(positions), k)
        # The probes used, once each when the directions are common to all.
        if np.ndim(directions) == 2:
            used, back = np.unique(found, return_inverse=True)
            density = _some(probes, rays, used, backend).evaluate(directions)
            return _mean_rows(density, back.reshape(found.shape))
        density = [
            _some(probes, rays, near, backend).evaluate(d).mean(axis=0, dtype=np.float64)
            for near, d in zip(found, directions)
        ]
        return np.stack(density)

    return evaluate


def make_nearest_rays_baseline(rays: Rays, k: int = 4096, *, kappa: float = 20.0, backend: Backend = None) -> Baseline:
    """KDE of the ``k`` training rays whose origins are nearest to a position: a
    probe without a radius, hard to beat where rays are many."""
    from scipy.spatial import KDTree

    tree = KDTree(rays.origin, leafsize=_LEAF)
    k = min(k, len(rays))

    def evaluate(positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        positions, directions = np.atleast_2d(positions), np.asarray(directions)
        out = []
        for start in range(0, len(positions), 64):  # 64 x 4,096 rays at a time
            found = _nearest(tree, positions[start : start + 64], k)
            kde = SphericalKde(rays.direction[found.ravel()], np.arange(len(found) + 1) * k, kappa, backend=backend)
            out.append(kde.evaluate(directions if directions.ndim == 2 else directions[start : start + 64]))
        return np.concatenate(out)

    return evaluate


def make_standard_baselines(
    rays: Rays, radius: float, kappa: float = 20.0, blind_kappa: float = 50.0, seed: int = 0, count: int = 2048
) -> tuple[Baseline, dict[str, Baseline]]:
    """``(blind, baselines)``: the density that information is counted from, and by name all that a gaze field is shown
    beside: uniform, position-blind, nearest probes and nearest rays of the training ``rays``, kernels of ``kappa``."""
    probes = place_probes(
        rays, radius, count=count, min_rays=min(64, len(rays)), kappa_rule="fixed", kappa=kappa, seed=seed
    )
    blind = make_position_blind_baseline(rays, kappa=blind_kappa)
    return blind, {
        "uniform": make_uniform_baseline(),
        "position-blind": make_position_blind_baseline(rays, kappa=kappa),
        f"position-blind, kappa {blind_kappa:g}": blind,
        "nearest probe": make_nearest_probes_baseline(probes, 1),
        "16 nearest probes": make_nearest_probes_baseline(probes, 16),
        "4,096 nearest rays": make_nearest_rays_baseline(rays, 4096, kappa=kappa),
    }


def _nearest(tree: Any, positions: np.ndarray, k: int) -> np.ndarray:
    """Indices (P, k) of the ``k`` points of a KD-tree that are nearest to each of ``positions`` (P, 3)."""
    return tree.query(positions, k=np.arange(1, k + 1))[1]


def _some(probes: Probes, rays: list[np.ndarray], which: np.ndarray, backend: Backend) -> SphericalKde:
    """The densities of the probes ``which`` of ``probes``, whose rays are at ``rays``."""
    runs = [rays[p] for p in which]
    offsets = np.concatenate([[0], np.cumsum([len(r) for r in runs])])
    flat = np.concatenate(runs)
    weights = None if probes.weights is None else probes.weights[flat]
    return SphericalKde(probes.directions[flat], offsets, probes.kappa[which], weights, backend)


def _mean_rows(density: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Mean (P, D) of the ``rows`` (P, k) of ``density`` (n, D)."""
    return np.stack([density[r].mean(axis=0, dtype=np.float64) for r in rows])


# ---- A trained gaze field beside its baselines: densities over the sphere at positions, and a table of scores ----


# Of the uniform density: what a density of zero counts as in KLD. A truth that is a kernel density has
# long empty stretches where nothing should hinge on how empty exactly.
EPS = 1e-6


class FieldDensity:
    """``field`` in a place as a function ``(positions (P, 3), directions) -> (P, D)`` of densities in 1/sr of the
    positions' units.

    What the integrator ``nerg`` shows on surfaces for an observer there, by the same functions: its depths, its
    integral of a normalised field, its mean of an ensemble. Where no surface is met the field is as it was trained.

    ``medium``: what the observer's depth is traced in, in the field's frame (a medium or a ``Place``; None for a field
    that knows no geometry); ``align``: similarity from the frame of the positions to the field's. The integrals of
    positions are kept: neither the field nor its place may change. ``on_position`` is told how many positions are
    known, after each new one. Raises `NergError` for a field that needs surfaces where there is no place.
    """

    def __init__(
        self,
        field: AnyGazeField,
        medium,
        align: Similarity | None = None,
        depth_kind: str = "median",
        on_position: Callable[[int], None] | None = None,
    ):
        if medium is None and field.config.needs_surfaces:
            raise NergError(
                "this gaze field was trained among surfaces, and there is no place that has any: give it the field, "
                "the scene or the geometry"
            )
        self._gaze, self._place = GazeFieldInstance(field), medium if isinstance(medium, SceneGeometry) else SceneGeometry(medium)
        march = default_march_settings(self._place)
        self._settings = ObserverSettings(march=march, depth=depth_kind, surface_opacity=SURFACE_OPACITY)
        self._align, self._on_position = align or Similarity(), on_position
        self._observed: dict[bytes, ObservedGaze] = {}

    def __call__(self, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Densities (P, D) of positions (P, 3) in unit directions (D, 3) or (P, D, 3)."""
        return self.members(positions, directions).mean(axis=0)

    def members(self, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """The same of each member of an ensemble (M, P, D); of one field, that alone."""
        align = self._align
        positions = np.atleast_2d(np.asarray(positions, np.float64)) @ align.matrix[:3, :3].T + align.matrix[:3, 3]
        directions = np.asarray(directions, np.float64) @ (align.matrix[:3, :3] / align.scale).T
        directions = np.broadcast_to(directions, (len(positions), *directions.shape[-2:]))
        return np.stack([self._of(p, d) for p, d in zip(positions, directions)], axis=1)

    def _of(self, position: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Densities (M, D) of one observer (3,), both in the field's frame."""
        mi = variant_types()
        p_o, key = mi.Point3f(*position.tolist()), position.tobytes()
        new = key not in self._observed
        if new:
            self._observed[key] = self._gaze.for_observers([p_o], self._place, self._settings)
        r_o = to_vector(mi.Vector3f, directions)
        density = np.stack([np.array(m) for m in self._observed[key].evaluate_members_along(p_o, r_o)])
        if new and self._on_position is not None:
            self._on_position(len(self._observed))
        return density


def format_score_table(rows: list[dict], title: str) -> str:
    """``rows`` as a table for the terminal."""
    from rich.console import Console
    from rich.table import Table

    out = Table(title=title, title_justify="left")
    for k in rows[0]:
        out.add_column(k, justify="left" if isinstance(rows[0][k], str) else "right")
    for row in rows:
        out.add_row(*(v if isinstance(v, str) else f"{v:.4f}" if k == "MAE" else f"{v:.3f}" for k, v in row.items()))
    # A width of its own: a table in a file or a pipe must not be folded.
    console = Console(width=120)
    with console.capture() as text:
        console.print(out)
    return text.get().removesuffix("\n")


# ---- A gaze field at positions, and of people, that it was not trained on, beside what needs no field ----
#
# Truth at a test position is the kernel density of the rays within R of it. Maps are compared over directions of equal
# area, rays one by one as they are. What is uncertain is which people came: intervals are a bootstrap over persons, who
# are drawn whole, with all of their rays (Efron & Tibshirani 1993).

SPLITS = ("both", "pos", "people")  # What may be new to a field: positions and people, positions, or people
MAP_SCORES, RAY_SCORES = ("KLD", "CC", "SIM", "MAE"), ("NSS", "AUC", "sAUC", "bits", "loglik")
SCORES = MAP_SCORES + RAY_SCORES
"""KLD in nats and CC, SIM of densities normalised over the sphere; MAE in 1/sr of densities as they are; NSS; AUC-Judd;
sAUC against rays of other test positions; bits a ray beyond the blind density; mean log density (nats of 1/sr)."""
# Share of an evaluation's time that goes to the densities of methods that are quick; the rest goes to resamples.
_ANSWERS = 0.2
_PER_POSITION = 128  # Rays that are drawn at each test position, and scored one by one


@dataclass(frozen=True, eq=False)
class GazeTest:
    """What a density is scored on at P positions, of N persons, in D directions and by K rays each."""

    centres: np.ndarray  # Positions (P, 3), metres, in the rays' frame
    directions: np.ndarray  # Directions (D, 3) of equal area, in which maps are compared
    truth: np.ndarray  # True densities (P, D), 1/sr
    participant_densities: np.ndarray  # Those of each person alone (P, N, D)
    counts: np.ndarray  # Rays of each person at each position (P, N)
    participants: tuple[str, ...]  # Names of the persons
    sample_directions: np.ndarray  # Rays drawn at each position (P, K, 3)
    sample_participants: np.ndarray  # Whose they are (P, K), indices of the persons
    other_directions: np.ndarray  # Rays drawn at other positions (P, K, 3)

    @cached_property
    def query_directions(self) -> np.ndarray:
        """Rays that densities are asked for, (P, 2 K, 3): those drawn at each position, then those at others."""
        return np.concatenate([self.sample_directions, self.other_directions], axis=1)


def select_held_out_rays(rays: Rays, holdout: dict, split: str = "both", seed: int = 0) -> tuple[Rays, Rays, np.ndarray]:
    """``(training rays, test rays, test centres)`` of a checkpoint's ``account`` of what it held out (``hold_out``).

    ``split``: ``both``: positions and people that are new; ``pos``: people who were trained on, at new positions;
    ``people``: new people where others were trained on. Raises ``NergError`` where nobody was held out.
    """
    if split not in SPLITS:
        raise NergError(f'the split must be one of {", ".join(SPLITS)}, got "{split}"')
    centres, unseen = np.array(holdout["centres"]), np.zeros(len(rays), bool)
    if holdout.get("people"):
        unseen = split_by_person(rays, test_persons=holdout["people"])[1]
    elif split != "pos":
        raise NergError(
            f'no people were held out of this training, so that there is no split "{split}"; train with --test-people'
        )
    away = purge(rays, centres, holdout["purged_within"])
    train = rays.select(~unseen & away)
    if split == "people":
        scored = rays.select(unseen & away)
        return train, scored, scored.origin[np.random.default_rng(seed).permutation(len(scored))[: len(centres)]]
    return train, rays.select(unseen if split == "both" else ~unseen), centres


# Memory of an evaluation at most: maps of each person in single precision, and of a dozen methods in double.
_BYTES_A_METHOD, _MOST_BYTES = 100, 2e9


def make_test(
    rays: Rays,
    centres: np.ndarray,
    radius: float,
    kappa: float = 20.0,
    directions: int = 2048,
    min_rays: int = 64,
    max_rays: int = 1024,
    seed: int = 0,
) -> GazeTest:
    """Truth around those of ``centres`` that have ``min_rays`` rays within ``radius`` metres, by kernels of ``kappa``.

    ``directions``: that maps are compared in; ``cap``: rays that a truth is made of at most, the nearest; ``seed``: of
    the rays that are drawn. Raises `NergError` where none has.
    """
    enough = _enough(rays, centres, radius, min_rays)
    if not enough.any():
        raise NergError(f"none of {len(centres)} test positions has {min_rays} rays within {radius} m; lower min_rays")
    probes = place_probes(
        rays, radius, queries=centres[enough], max_rays=max_rays, min_rays=1, kappa_rule="fixed", kappa=kappa, centre="query"
    )
    d, rng = fibonacci_directions(directions), np.random.default_rng(seed)
    person = rays.person[probes.indices]
    present = np.unique(person)
    P, N = len(probes), len(present)
    if (size := P * directions * (4 * N + _BYTES_A_METHOD)) > _MOST_BYTES:
        raise NergError(
            f"maps of {directions:,} directions at {P} positions, of {N} persons, take {size / 1e9:.0f} GB; ask for "
            "fewer --directions, of which some thousand tell maps apart as well"
        )
    parts, counts = np.zeros((P, N, directions), np.float32), np.zeros((P, N))
    probe = np.repeat(np.arange(P), probes.counts)
    # Runs of one person at one position are mixtures of their own.
    order = np.lexsort((person, probe))
    pair = np.stack([probe[order], np.searchsorted(present, person[order])], axis=1)
    runs, first = np.unique(pair, axis=0, return_index=True)
    kde = SphericalKde(probes.directions[order], np.append(first, len(order)), kappa)
    parts[runs[:, 0], runs[:, 1]] = kde.evaluate(d)
    counts[runs[:, 0], runs[:, 1]] = np.diff(np.append(first, len(order)))
    which = np.stack([rng.integers(a, b, _PER_POSITION) for a, b in zip(probes.offsets[:-1], probes.offsets[1:])])
    at = probes.directions[which]
    # From farther away than 2R where there is such a position, so that no ray is on both sides.
    apart = np.linalg.norm(probes.queries[:, None] - probes.queries[None], axis=2)
    far = [np.flatnonzero(row > 2 * radius) if (row > 2 * radius).any() else np.flatnonzero(row > 0) for row in apart]
    others = np.stack(
        [
            at[rng.choice(f, _PER_POSITION), rng.integers(0, _PER_POSITION, _PER_POSITION)] if len(f) else at[i]
            for i, f in enumerate(far)
        ]
    )
    truth = np.einsum("pn,pnd->pd", counts / counts.sum(axis=1, keepdims=True), parts)
    names = tuple(rays.persons[i] for i in present)
    return GazeTest(
        centres[enough], d, truth, parts, counts, names, at, np.searchsorted(present, person[which]), others
    )


def _enough(rays: Rays, centres: np.ndarray, radius: float, min_rays: int) -> np.ndarray:
    """Which of ``centres`` (P,) have ``min_rays`` rays within ``radius`` metres."""
    from scipy.spatial import KDTree

    return KDTree(rays.origin).query_ball_point(centres, radius, return_length=True) >= min_rays


def evaluate_gaze(
    test: GazeTest,
    methods: dict[str, Baseline],
    blind: Baseline,
    resamples: int = 200,
    seed: int = 0,
    on_progress: Callable[[float], None] | None = None,
) -> list[dict]:
    """One row a method: the scores of ``SCORES``, each with ``.low`` and ``.high`` of a 95 % interval, and the
    integral.

    ``blind``: the density that bits are counted from. An interval is 1.96 standard errors of the bootstrap either way;
    not its quantiles, since the truth of a resample has fewer persons and narrower peaks, which every map meets worse.
    The resamples are the same for all methods: the last method is the bar, and of the first one the row has ``.less``,
    how much it is above the bar, with ``.less.low`` and ``.less.high``. The row of every other method has ``.gap``, how
    much the first method is above it, likewise. With fewer than three persons there are no intervals. ``on_part`` is
    told the share that is done.
    """
    rng, N = np.random.default_rng(seed), len(test.participants)
    told = on_progress or (lambda share: None)
    answers = _answers(test, methods, blind, lambda share: told(_ANSWERS * share))
    rows = [
        {"method": name, **compute_map_scores(test.truth, maps), **{k: float(v.mean()) for k, v in values.items()}}
        for name, maps, values in answers
    ]
    boot = [[] for _ in answers]
    for number in range(resamples if N >= 3 else 0):
        told(_ANSWERS + (1 - _ANSWERS) * number / resamples)
        times = rng.multinomial(N, np.full(N, 1 / N))
        share = test.counts * times
        held = share.sum(axis=1) > 0
        share = share[held] / share[held].sum(axis=1, keepdims=True)
        truth, weight = np.einsum("pn,pnd->pd", share, test.participant_densities[held]), times[test.sample_participants].astype(float)
        for kept, (_, maps, values) in zip(boot, answers):
            kept.append(
                {
                    **compute_map_scores(truth, maps[held]),
                    **{k: float((v * weight).sum() / weight.sum()) for k, v in values.items()},
                }
            )
    for row, kept, (_, maps, _) in zip(rows, boot, answers):
        for k in SCORES if kept else ():
            reach = 1.96 * np.std([b[k] for b in kept])
            row[f"{k}.low"], row[f"{k}.high"] = float(row[k] - reach), float(row[k] + reach)
        row["integral"] = float(4 * np.pi * maps.mean())
    for other, kept in zip(rows[1:], boot[1:]):
        for k in SCORES:
            other |= _difference(f"{k}.gap", rows[0][k] - other[k], [a[k] - b[k] for a, b in zip(boot[0], kept)])
    if len(rows) > 1:
        for k in SCORES:
            rows[0] |= {key.replace(".gap", ".less"): v for key, v in rows[-1].items() if key.startswith(f"{k}.gap")}
    return rows


def _difference(name: str, value: float, resampled: list[float]) -> dict[str, float]:
    """``value`` by ``name``, and the ends of its 95 % interval, where it was ``resampled``."""
    if not resampled:
        return {name: value}
    reach = 1.96 * np.std(resampled)
    return {name: value, f"{name}.low": float(value - reach), f"{name}.high": float(value + reach)}


def _answers(
    test: GazeTest, methods: dict[str, Baseline], blind: Baseline, on_part: Callable[[float], None] | None = None
) -> list[tuple[str, np.ndarray, dict[str, np.ndarray]]]:
    """``(name, maps (P, D), ray scores (P, K) by name)`` of each method. ``on_part`` is told the share that is done."""
    K = test.sample_directions.shape[1]
    ask = lambda method: [np.asarray(method(test.centres, v), np.float64) for v in (test.directions, test.query_directions)]
    maps, at = ask(blind)
    log_prior, out = _log(at[:, :K], maps), []
    for name, method in methods.items():
        maps, at = ask(method)
        out.append((name, maps, compute_ray_scores(maps, at[:, :K], at[:, K:], log_prior)))
        if on_part is not None:
            on_part(len(out) / len(methods))
    return out


def score_participants(test: GazeTest, methods: dict[str, Baseline], blind: Baseline, min_rays: int = 64) -> list[dict]:
    """One row a method and person: the person's rays, scored; map scores at positions of ``min_rays`` such rays."""
    rows = []
    for name, maps, values in _answers(test, methods, blind):
        for i, person in enumerate(test.participants):
            own, enough = test.sample_participants == i, test.counts[:, i] >= min_rays
            scores = dict.fromkeys(MAP_SCORES, float("nan"))
            if enough.any():
                scores = compute_map_scores(test.participant_densities[enough, i], maps[enough])
            rays = {k: float(v[own].mean()) if own.any() else float("nan") for k, v in values.items()}
            rows.append({"method": name, "person": person, "rays": int(test.counts[:, i].sum()), **scores, **rays})
    return rows


def score_split_half(
    test_rays: Rays,
    centres: np.ndarray,
    radius: float,
    kappa: float,
    blind: Baseline,
    min_rays: int = 64,
    seed: int = 0,
) -> dict | None:
    """Scores of one half of the people of ``test_side`` as predicted by the other, where both have ``min_rays`` rays: a
    reference and no bound. None where there is no such position, or only one person."""
    if len(np.unique(test_rays.person)) < 2:
        return None
    halves = [test_rays.select(mask) for mask in split_by_person(test_rays, seed=seed)]
    both = np.logical_and(*(_enough(half, centres, radius, min_rays) for half in halves))
    if not both.any():
        return None
    first = make_test(halves[0], centres[both], radius, kappa, min_rays=min_rays)
    probes = place_probes(
        halves[1], radius, queries=first.centres, min_rays=1, kappa_rule="fixed", kappa=kappa, centre="query"
    )
    predicted = lambda positions, directions: probes.density(directions)
    row = evaluate_gaze(first, {"split half": predicted}, blind, resamples=0)[0]
    return {k: v for k, v in row.items() if "." not in k}


def compute_map_scores(truth: np.ndarray, maps: np.ndarray) -> dict[str, float]:
    """Means over positions of the scores of ``MAPS``."""
    return {
        "KLD": float(metrics.kld(truth, maps, eps=EPS).mean()),
        "CC": float(metrics.cc(truth, maps).mean()),
        "SIM": float(metrics.sim(truth, maps).mean()),
        "MAE": float(metrics.mae(truth, maps).mean()),
    }


def compute_ray_scores(maps: np.ndarray, sample_densities: np.ndarray, other_densities: np.ndarray, log_prior: np.ndarray) -> dict[str, np.ndarray]:
    """The scores of ``RAYS`` of each ray, (P, K), from the densities ``maps`` (P, D), at the rays ``at`` (P, K), and at
    rays that were seen from elsewhere, ``others`` (P, M). AUC of a ray: the share of the sphere whose density is lower,
    ties half; their mean is AUC-Judd with as many thresholds as there are values."""
    log = _log(sample_densities, maps)
    below = lambda among: np.stack([_share_below(a, g) for a, g in zip(among, sample_densities)])
    return {
        "NSS": metrics.nss(maps, sample_densities),
        "AUC": below(maps),
        "sAUC": below(other_densities),
        "bits": (log - log_prior) / np.log(2),
        "loglik": log,
    }


def _log(at: np.ndarray, maps: np.ndarray) -> np.ndarray:
    """Log of densities at rays, normalised over the sphere; what is negative or zero counts as the smallest."""
    sphere = 4 * np.pi * np.maximum(maps, 0).mean(axis=1, keepdims=True)
    return np.log(np.maximum(at, 0) / np.where(sphere > 0, sphere, 1) + np.finfo(float).eps)


def _share_below(row: np.ndarray, gaze: np.ndarray) -> np.ndarray:
    ordered = np.sort(row)
    return 0.5 * (np.searchsorted(ordered, gaze, "left") + np.searchsorted(ordered, gaze, "right")) / len(row)
