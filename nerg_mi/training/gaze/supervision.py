"""What a gaze field learns from: probes, the directions around each, the true densities, and the surfaces they meet.

The radiance field (or any medium) is frozen while gaze is trained and each probe keeps its directions, so every depth
is traced once, before the training.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from nerg_mi.density.kde.estimate import SphericalKde
from nerg_mi.density.probes import Probes, person_weights, place_probes
from nerg_mi.field.gaze.log_density import LogGazeConfig, blind_table, table_directions
from nerg_mi.maths.box import Box
from nerg_mi.maths.ray_box import box_interval
from nerg_mi.maths.similarity import Similarity
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.rays.rays import Rays
from nerg_mi.transport.observer.integral import nearest_depth
from nerg_mi.transport.trace import trace_depth

from .semantics import semantic_features
from .settings import ProbeSettings

# Concentration of the blind density's kernels, and of how many rays it is made at most. Wide, because the field learns
# what it lacks from many probes, but nothing takes back the peaks of a few people, which others do not share.
_BLIND_KAPPA = 10.0
_BLIND_RAYS = 1 << 16
# How far everything is where no geometry is known, in the field's units.
NOWHERE = 2.0
# Opacity from which on a ray has met a surface; the integrator's default.
SURFACE_OPACITY = 0.5


@dataclass(frozen=True, eq=False)
class Supervision:
    """P probes with D directions of equal area each, in the field's frame and units, float32.

    ``positions`` (P, 3), the observers p_o; ``directions`` (P, D, 3), unit, r_o; ``truth`` (P, D), 1/sr; ``distance``
    (P, D), from p_o to p_od; ``escaped`` (P, D) bool: no surface was met, and p_od is where the box ends. ``semantic``
    (P, D, F), float16: features of a radiance field, for a gaze field that wants them. ``blind``: table of the log of
    the rays' density whatever their position (``field.gaze.log_density``), for one that begins with it.
    ``renew(epoch)``: the same probes in other directions, where each epoch is to have its own. ``extent`` (P,): solid
    angle in sr of which the D directions are equal parts and over which the truth integrates to one, where that is not
    the sphere (None) but a view.
    """

    positions: np.ndarray
    directions: np.ndarray
    truth: np.ndarray
    distance: np.ndarray
    escaped: np.ndarray
    semantic: np.ndarray | None = None
    blind: np.ndarray | None = None
    renew: Callable[[int], Supervision] | None = None
    extent: np.ndarray | None = None

    @property
    def escape_share(self) -> float:
        """Share of the directions that meet no surface."""
        return float(self.escaped.mean())

    @property
    def escaped_gaze(self) -> float:
        """Share of the true gaze that goes where no surface is."""
        gaze = self.truth if self.extent is None else self.truth * self.extent[:, None]
        return float((gaze * self.escaped).sum() / gaze.sum())


def supervise(
    probes: Probes,
    medium,
    box: Box,
    count: int,
    align: Similarity | None = None,
    kind: str = "median",
    seed: int | tuple = 0,
    semantic: str = "",
    fill: bool = False,
) -> Supervision:
    """Directions, true densities and surfaces of ``probes``.

    ``medium``: what depths are traced in (see ``surfaces``) and ``box``, where the gaze field will
    live: both in the field's frame. ``count``: directions a probe, a Fibonacci set under a rotation of its own, so that
    together the probes see what one set leaves out. ``align``: similarity from the rays' frame to the field's.
    ``semantic``: which features of ``medium`` to keep (``field.gaze.product.SEMANTICS``); ``fill``: see ``surfaces``.
    """
    align = align or Similarity()
    directions = rotated_sets(count, len(probes), np.random.default_rng(seed))
    truth = probes.density(directions)
    rotation = align.matrix[:3, :3] / align.scale
    positions = probes.positions @ align.matrix[:3, :3].T + align.matrix[:3, 3]
    return observe(positions, directions @ rotation.T, truth, medium, box, kind, semantic, fill)


def observe(
    positions, directions, truth, medium, box: Box, kind: str = "median", semantic: str = "", fill: bool = False
) -> Supervision:
    """Supervision by observers (P, 3) whose density in ``directions`` (P, D, 3) is ``truth`` (P, D), all in the field's
    frame, with the surfaces that they see. The other arguments are those of ``supervise``."""
    distance, escaped = surfaces(medium, box, positions, directions, kind, fill)
    features = None
    if semantic:
        origins = np.repeat(positions, directions.shape[1], axis=0)
        features = semantic_features(medium, origins, directions.reshape(-1, 3), distance.ravel(), semantic)
        features = features.reshape(*directions.shape[:2], -1)
    narrow = (v.astype(np.float32, copy=False) for v in (positions, directions, truth))
    return Supervision(*narrow, distance, escaped, features)


def supervise_rays(
    rays: Rays,
    medium,
    box: Box,
    settings: ProbeSettings,
    align: Similarity | None = None,
    queries: np.ndarray | None = None,
    seed: int = 0,
    semantic: str = "",
    config=None,
) -> Supervision:
    """Probes on ``rays``, at ``queries`` (P, 3) metres where given, and what ``supervise`` makes of them. ``config``:
    of the gaze field; a ``LogGazeConfig`` has the blind density made, and says what to do with directions that escape.
    With ``settings.fresh`` the result can ``renew`` its directions."""
    s, log = settings, isinstance(config, LogGazeConfig)
    probes = place_probes(
        rays,
        s.radius,
        placement=s.placement,
        count=s.count,
        spacing=s.spacing,
        queries=queries,
        cap=s.cap,
        min_rays=min(s.min_rays, s.cap),
        kappa_rule=s.kappa_rule,
        kappa=s.kappa,
        weights=s.weights,
        seed=seed,
    )
    turned = lambda seed: supervise(
        probes, medium, box, s.directions, align, s.depth, seed, semantic, log and config.escaped == "nearest"
    )
    out = turned(seed)
    if s.fresh:
        out = replace(out, renew=lambda epoch: turned((seed, epoch)))
    return replace(out, blind=blind_prior(rays, config.prior, align, seed, s.weights)) if log else out


def blind_prior(
    rays: Rays, rows: int, align: Similarity | None = None, seed: int = 0, weights: str = "equal"
) -> np.ndarray:
    """``field.gaze.log_density.blind_table`` of what people look at wherever they stand, in the field's frame.
    ``weights``: with ``person`` all people count alike, however many rays are theirs."""
    align = align or Similarity()
    which = np.random.default_rng(seed).permutation(len(rays))[:_BLIND_RAYS]
    # The table's directions in the rays' frame: its inverse is a rotation's transpose.
    each = person_weights(rays)[which] if weights == "person" else None
    kde = SphericalKde(rays.direction[which], np.array([0, len(which)]), _BLIND_KAPPA, each)
    density = kde.evaluate(table_directions(rows) @ (align.matrix[:3, :3] / align.scale))[0]
    return blind_table(density, rows, kde.ns, fibonacci_directions(1 << 16))


def surfaces(
    medium, box: Box, positions, directions, kind: str = "median", fill: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Distances from ``positions`` (P, 3) along ``directions`` (P, D, 3) to the surface that each meets, and which meet
    none.

    Both (P, D): float32 in the field's units, and bool. ``medium``: see ``trace_depth``; None: no geometry, everything
    is ``NOWHERE`` away and nothing counts as escaped. A direction that meets no surface ends where it leaves the box
    (or after the box's diagonal, where it never enters): it still needs a p_od at which the field is evaluated. With
    ``fill`` it ends at the depth of the directions of its position nearest to it that do meet one: where the geometry
    has holes.
    """
    P, D = directions.shape[:2]
    if medium is None:
        return np.full((P, D), NOWHERE, np.float32), np.zeros((P, D), bool)
    origins = np.repeat(np.asarray(positions, np.float64), D, axis=0)
    flat = np.asarray(directions, np.float64).reshape(-1, 3)
    depth, opacity = trace_depth(medium, origins, flat, kind=kind)
    escaped = opacity < SURFACE_OPACITY
    depth[escaped] = box_exit(box, origins[escaped], flat[escaped])
    depth, escaped = depth.reshape(P, D), escaped.reshape(P, D)
    if fill:
        for p in np.flatnonzero(escaped.any(axis=1) & ~escaped.all(axis=1)):
            met = ~escaped[p]
            depth[p, escaped[p]] = nearest_depth(directions[p, met], depth[p, met], directions[p, escaped[p]])
    return depth, escaped


def box_exit(box: Box, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance (N,) at which rays leave ``box``; its diagonal for rays that never enter it."""
    near, far = box_interval(origins, directions, box.lower, box.upper)
    return np.where((far > 0) & (near <= far) & np.isfinite(far), far, box.diagonal)


def rotated_sets(count: int, sets: int, rng: np.random.Generator) -> np.ndarray:
    """``sets`` Fibonacci sets of ``count`` directions, each turned by a uniform random rotation, (sets, count, 3)."""
    from scipy.spatial.transform import Rotation

    # Unit quaternions from normal numbers are uniform rotations (Shoemake 1992); the first is the real part.
    rotation = Rotation.from_quat(np.roll(rng.normal(size=(sets, 4)), -1, axis=1)).as_matrix()
    return np.einsum("dj,pij->pdi", fibonacci_directions(count), rotation)
