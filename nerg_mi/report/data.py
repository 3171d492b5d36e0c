"""What a report shows: one run of a gaze field with its scores, its areas, glances and the stage on which they
stand."""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from nerg_mi.evaluation.gaze_report import GazeResults, Verdict, compute_verdict, small_sample_factor
from nerg_mi.fields.gaze_base import AnyGazeField
from nerg_mi.figures.overlay import srgb, to_bytes
from nerg_mi.formats.areas import Region
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.types import variant_types
from nerg_mi.rays.quality import RaysSummary
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.bands import render_channels
from nerg_mi.statistics.shares import DirectionQuery, Shares
from nerg_mi.statistics.visits import Aoi, HitAssignment, assign_hits, regroup
from nerg_mi.train.gaze_data import SURFACE_OPACITY
from nerg_mi.train.geometry import TrainingGeometry
from nerg_mi.transport.geometry import SceneGeometry, default_march_settings, trace_depth
from nerg_mi.transport.observer import ObserverSettings
from nerg_mi.transport.observer_gaze import GazeFieldInstance, make_gaze_evaluator

# ---- Glances ----
#
# What people could look at, and how much gaze a field says they give it: from places where they stood, in all
# directions. Everything is in the coordinates of the place.

_GOLDEN = (math.sqrt(5) - 1) / 2
# Directions of the integral of a normalised field: shares are divided by their own sum.
_INTEGRAL = 2048


@dataclass(frozen=True, eq=False)
class EyePositions:
    """Where people stood: ``positions`` (P, 3), and whose they are, ``person`` (P,)."""

    positions: np.ndarray
    participant: np.ndarray


class GazeSampler:
    """A gaze field in its place, asked about observers in the place's coordinates.

    ``kind``: of the depth at which a ray meets its surface.
    """

    def __init__(self, field: AnyGazeField, geometry: TrainingGeometry, kind: str = "median"):
        self.field, self._kind = field, kind
        self._place = geometry.medium if isinstance(geometry.medium, SceneGeometry) else SceneGeometry(geometry.medium)
        self._known = geometry.medium is not None
        march = default_march_settings(self._place)
        self._settings = ObserverSettings(
            march=march, depth=kind, surface_opacity=SURFACE_OPACITY, directions=_INTEGRAL
        )
        self._gaze = GazeFieldInstance(field)

    def trace(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depth (N,) along rays (N, 3), and whether they meet a surface; nothing is met where no place is known."""
        if not self._known:
            return np.zeros(len(origins), np.float32), np.zeros(len(origins), bool)
        depth, opacity = trace_depth(self._place, origins, directions, kind=self._kind)
        return depth, (opacity >= SURFACE_OPACITY) & (depth > 0)

    def density(self, observer: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Gaze (N,) in 1/sr of the ``observer`` (3,) in unit ``directions`` (N, 3)."""
        mi = variant_types()
        center = mi.Point3f(*np.asarray(observer, float).tolist())
        observed = self._gaze.for_observers([center], self._place, self._settings)
        return np.array(observed.along(center, to_vector(mi.Vector3f, directions)))

    def density_at_points(self, observer: np.ndarray, points: np.ndarray, spacing: float) -> np.ndarray:
        """Gaze (N,) in 1/sr that the ``observer`` (3,) gives ``points`` (N, 3) of surfaces, none to those that are
        hidden by more than twice the ``spacing``."""
        away = points - observer
        distance = np.linalg.norm(away, axis=1)
        directions = away / np.maximum(distance, 1e-9)[:, None]
        depth, met = self.trace(np.broadcast_to(observer, points.shape), directions)
        seen = ~met | (depth >= distance - 2 * spacing)
        return np.where(seen, self.density(observer, directions), 0)

    def query_from(self, observer: np.ndarray) -> DirectionQuery:
        """What the observer at ``eye`` (3,) meets and gives their gaze, as `gaze_shares` wants it."""
        return make_gaze_evaluator(self._gaze, self._place, self._settings, observer)


def sample_eye_positions(rays: Rays, geometry: TrainingGeometry, most: int) -> EyePositions:
    """About ``most`` of the positions of ``rays``, in the place's coordinates, as many of each person: evenly chosen
    among theirs in the order of time, and begun at another part of it for each person, so that all together are spread
    over whole visits even where each person has only one. Of more people than that so many, evenly chosen."""
    there = np.unique(rays.person)
    if len(there) > most:
        there = there[np.linspace(0, len(there) - 1, most).astype(int)]
    each, chosen = max(1, most // len(there)), []
    # Multiples of the golden ratio, modulo one, are spread evenly however many there are; the first is one half.
    starts = (0.5 + np.arange(len(there)) * _GOLDEN) % 1
    for person, start in zip(there, starts):
        own = np.flatnonzero(rays.person == person)
        own = own[np.argsort(rays.t[own], kind="stable")]
        count = min(each, len(own))
        # At the same share of as many equal stretches.
        chosen.append(own[((np.arange(count) + start) * len(own) / count).astype(int)])
    rows = np.concatenate(chosen)
    return EyePositions(geometry.points_to_field(rays.origin[rows]), rays.person[rows])


def assign_ray_hits(
    rays: Rays,
    geometry: TrainingGeometry,
    sampler: GazeSampler,
    most: int,
    things: Sequence[Aoi],
    members: Sequence[tuple[int, ...]],
    margin: float,
) -> tuple[HitAssignment, np.ndarray]:
    """What up to ``most`` of the ``rays``, evenly chosen, are on of objects that consist of ``things`` by their
    numbers, ``members``, and whose each is (N,). Rays end at their own hit points, or else at what they meet in the
    place. ``margin``: as of `visits.land`."""
    some = rays if len(rays) <= most else rays.select(np.linspace(0, len(rays) - 1, most).round().astype(int))
    origins, directions = geometry.points_to_field(some.origin), geometry.directions_to_field(some.direction)
    met, hit = sampler.trace(origins, directions)
    depth = np.where(hit, met, np.inf)
    if some.hit is not None:
        away = geometry.points_to_field(some.hit) - origins
        far = np.linalg.norm(away, axis=1)
        ends = np.isfinite(far) & (far > 0)
        directions = np.where(ends[:, None], away / np.where(ends, far, 1)[:, None], directions)
        depth = np.where(ends, far, depth)
    return regroup(assign_hits(things, origins, directions, depth, margin), members), some.person


# ---- Names ----
#
# People without their names: what a report shows of rays and of evaluations unless names are asked for.


# Metadata of rays that name nobody.
_KEPT = ("frame", "source_frame", "transform", "rows_read", "preset")
# Names of fewer characters are parts of too many words to be looked for within them.
_WORD = 3


class ParticipantLabels:
    """Numbered people, as in "person 1", in place of names: by the number of rays, the most first, and then those who
    are only named by evaluations."""

    def __init__(self, rays: Rays | None, results: Iterable[GazeResults] = ()):
        names: list[str] = []
        if rays is not None:
            count = np.bincount(rays.person, minlength=len(rays.persons))
            names = [rays.persons[i] for i in np.argsort(-count, kind="stable")]
        for found in results:
            names += [str(row["person"]) for row in found.participant_rows if "person" in row]
        self._number = {name: k + 1 for k, name in enumerate(dict.fromkeys(names))}
        self._label = {name: f"person {number}" for name, number in self._number.items()}

    def label(self, name: str) -> str:
        """What stands for ``name``."""
        return self._label.get(name, "a person")

    def number(self, name: str) -> int:
        """The number that stands for ``name``, 0 for nobody's."""
        return self._number.get(name, 0)

    def anonymize(self, text: str) -> str:
        """``text``, such as a file's name, with what stands for people in place of their names: also within words, but
        for names of one or two characters."""
        parts = sorted((n for n in self._label if n), key=len, reverse=True)
        pattern = "|".join(re.escape(n) if len(n) >= _WORD else rf"(?<!\w){re.escape(n)}(?!\w)" for n in parts)
        folded = {name.lower(): label for name, label in self._label.items()}
        swap = lambda found: folded.get(found.group().lower(), "a person")
        return re.sub(pattern, swap, text, flags=re.IGNORECASE) if pattern else text


def anonymize_rays(rays: Rays, labels: ParticipantLabels) -> Rays:
    """``rays`` whose people are called by ``labels``, and of whose metadata only that is left which names nobody."""
    about = {key: rays.metadata[key] for key in _KEPT if key in rays.metadata}
    files = [d.get("file") for d in rays.metadata.get("dropped", [])]
    number = {name: f"file {k + 1}" for k, name in enumerate(dict.fromkeys(files))}
    about["dropped"] = [{**d, "file": number[d.get("file")]} for d in rays.metadata.get("dropped", [])]
    words = ("step", "side", "kept", "of")
    about["steps"] = [{k: step[k] for k in words if k in step} for step in rays.metadata.get("steps", [])]
    # In the order of the labels, since that of names or files can be guessed.
    order = sorted(range(len(rays.persons)), key=lambda i: labels.number(rays.persons[i]))
    code = np.empty(len(order), np.int32)
    code[order] = np.arange(len(order))
    return replace(
        rays, person=code[rays.person], persons=tuple(labels.label(rays.persons[i]) for i in order), metadata=about
    )


def anonymize_results(results: GazeResults, labels: ParticipantLabels) -> GazeResults:
    """``found`` whose people are called by ``labels``."""
    persons = tuple({**row, "person": labels.label(str(row.get("person", "")))} for row in results.participant_rows)
    return replace(results, participant_rows=persons)


# ---- Objects ----
#
# How much attention named objects have: by the field, and by the rays; of people, each of whom counts alike.
#
# Intervals are of 95 %, of the mean over people: Student's t with n - 1 degrees of freedom, which for means is what the
# bootstrap over people comes to with many resamples, widened for few (`nerg_mi.evaluation.gaze_report.widening`).

LEAST_PEOPLE = 3
"""Fewer people than these give no interval."""


@dataclass(frozen=True)
class MeanShare:
    """A mean share of attention over people, and the 95 % interval of that mean; NaN where people are too few for
    it."""

    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class ObjectAttention:
    """Of what is called ``name``: ``field``: the share of gaze that the field says people give it where they stood;
    ``recorded``: the share of their rays that end at it (None without rays); ``saw``: people who stood somewhere from
    where it can be seen, and ``looked``: who have a ray on it, of ``people``; None where nobody was recorded."""

    name: str
    predicted: MeanShare
    recorded: MeanShare | None
    num_could_see: int | None
    num_looked: int | None
    num_participants: int | None


def summarize_objects(
    names: Sequence[str], shares: Shares, who: np.ndarray, recorded: tuple[HitAssignment, np.ndarray] | None = None
) -> tuple[ObjectAttention, ...]:
    """Attention on each of the objects called ``names``, by the ``shares`` of eyes, which are those of ``who`` (P,).

    ``recorded``: what people's rays land on, object by object, and whose each is (N,); without it the eyes are
    nobody's.
    """
    out = []
    for k, name in enumerate(names):
        share = shares.share[:, k]
        if recorded is None:
            out.append(ObjectAttention(name, MeanShare(float(share.mean()), math.nan, math.nan), None, None, None, None))
            continue
        landed, person = recorded
        on = np.zeros(len(person))
        on[landed.rows[k]] = 1.0
        rays = _each(on, person)
        saw = _each(shares.is_hit[:, k].astype(float), who)
        field, people = mean_over_people(_each(share, who)), len(np.unique(person))
        seen, looked = int(np.sum(saw > 0)), int(np.sum(rays > 0))
        out.append(ObjectAttention(name, field, mean_over_people(rays), max(seen, looked), looked, people))
    return tuple(out)


def mean_over_people(values: np.ndarray) -> MeanShare:
    """The mean of ``values`` (N,), one a person, between 0 and 1, and its interval."""
    mean, n = float(values.mean()), len(values)
    if n < LEAST_PEOPLE:
        return MeanShare(mean, math.nan, math.nan)
    # The bootstrap's standard error of a mean is that of the population: divided by n, not by n - 1.
    reach = 1.96 * float(values.std()) / math.sqrt(n) * small_sample_factor(n)
    return MeanShare(mean, max(mean - reach, 0.0), min(mean + reach, 1.0))


def _each(values: np.ndarray, person: np.ndarray) -> np.ndarray:
    """Mean of ``values`` for each person there is."""
    _, who, count = np.unique(person, return_inverse=True, return_counts=True)
    return np.bincount(who, weights=values) / count


# ---- Proxy ----
#
# A place as some ten thousand points that a browser draws by itself, with the gaze of observers baked into them.
#
# Points are what panoramas from several eyes show, one a small cube. All lengths are scene units.

GazeAt = Callable[[np.ndarray, np.ndarray, float], np.ndarray]
"""``(observer (3,), points (V, 3), spacing) -> (V,)``: gaze in 1/sr after occlusion, of points known to ``spacing``."""

# What is farther away than so many times the usual distance is left out: a sky, a glance through a window.
_FAR = 5.0
# Cubes along the longest edge of the place, to begin with.
_FINE = 320


@dataclass(frozen=True, eq=False)
class ReportProxy:
    """``vertices`` (V, 3) float32; ``normals`` (V, 3) unit, towards where they were seen from; ``colors`` (V, 3) uint8
    sRGB; ``gaze`` (M, V) in 1/sr of M observers; ``spacing``: edge of the cube that a point stands for."""

    vertices: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    gaze: np.ndarray
    spacing: float


def make_proxy(
    scene: Any,
    viewpoints: np.ndarray,
    up: np.ndarray,
    observers: np.ndarray,
    gaze: GazeAt,
    most: int = 80_000,
    size: tuple[int, int] = (320, 160),
    on_panorama: Callable[[int, int], None] | None = None,
) -> ReportProxy | None:
    """What panoramas of ``size`` from ``eyes`` (K, 3) show of ``scene`` (`mi.Scene`), as ``most`` points at most.

    The scene's integrator is ``nerg`` with the AOVs opacity and position. ``up`` (3,): up axis of the panoramas.
    ``observers`` (M, 3): whose ``gaze`` is baked. ``on_eye`` is told the panoramas done, and of how many. None where
    there is no surface.
    """
    parts = []
    for number, eye in enumerate(viewpoints):
        parts.append(_panorama(scene, np.asarray(eye, float), np.asarray(up, float), size))
        if on_panorama is not None:
            on_panorama(number + 1, len(viewpoints))
    points, normals, facing, colors, distance = (np.concatenate(columns) for columns in zip(*parts))
    if not len(points):
        return None
    near = distance <= _FAR * np.median(distance)
    values = np.concatenate([colors, facing], axis=1)
    points, values, spacing = downsample_points(points[near], normals[near], values[near], most)
    colors, normals = values[:, :3], smooth_normals(points, values[:, 3:])
    baked = [gaze(np.asarray(observer, float), points, spacing) for observer in observers]
    heat = np.stack(baked).astype(np.float32) if baked else np.zeros((0, len(points)), np.float32)
    return ReportProxy(points.astype(np.float32), normals.astype(np.float32), to_bytes(srgb(colors)), heat, spacing)


def downsample_points(
    points: np.ndarray, normals: np.ndarray, values: np.ndarray, max_points: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """The means of ``points`` (N, 3) and of their ``values`` (N, C) in each of at most ``most`` cubes, and the cubes'
    edge. Surfaces whose ``normals`` face opposite ways are kept apart, as the two sides of a thin wall are."""
    edge = float(np.ptp(points, axis=0).max()) / _FINE or 1.0
    side = np.argmax(np.abs(normals), axis=1)
    facing = 2 * side + (np.take_along_axis(normals, side[:, None], axis=1)[:, 0] > 0)
    while True:
        cell = np.floor((points - points.min(axis=0)) / edge).astype(np.int64)
        key = np.ravel_multi_index((*cell.T, facing), (*(cell.max(axis=0) + 1), 6))
        _, which, count = np.unique(key, return_inverse=True, return_counts=True)
        if len(count) <= max_points:
            break
        edge *= 1.1
    mean = lambda v: np.stack([np.bincount(which, weights=c) for c in v.T], axis=1) / count[:, None]
    return mean(points), mean(values), edge


def smooth_normals(points: np.ndarray, towards: np.ndarray, count: int = 12) -> np.ndarray:
    """Unit normals (N, 3) of the surface through ``points`` (N, 3), on the side of ``towards`` (N, 3): of the plane
    that lies nearest to each one's ``count`` nearest neighbours (its covariance's least axis). ``towards`` itself for
    fewer than three points."""
    from scipy.spatial import KDTree

    facing = towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    count = min(count, len(points))
    if count < 3:
        return facing
    near = points[KDTree(points).query(points, k=count)[1]]
    apart = near - near.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", apart, apart))[1][:, :, 0]
    return np.where((normals * facing).sum(axis=1, keepdims=True) < 0, -normals, normals)


def _panorama(
    scene: Any, eye: np.ndarray, up: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals, directions to the eye, linear colours, (N, 3) each, and distances (N,) of what is met around
    ``eye``."""
    import mitsuba as mi

    level = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0])
    look = mi.ScalarTransform4f().look_at(origin=eye.tolist(), target=(eye + level).tolist(), up=up.tolist())
    film = {"type": "hdrfilm", "width": size[0], "height": size[1], "rfilter": {"type": "box"}}
    film |= {"component_format": "float32", "pixel_format": "rgb"}
    sensor = mi.load_dict({"type": "panorama", "to_world": look, "film": film})
    found = render_channels(scene, sensor, spp=1)
    points = np.stack([found.aovs[f"position.{axis}"] for axis in "XYZ"], axis=-1).astype(np.float64)
    met = found.mask & np.isfinite(points).all(axis=-1)
    away = eye - points
    distance = np.linalg.norm(away, axis=-1)
    met &= distance > 0
    normals = surface_normals(np.where(met[..., None], points, np.nan), away)
    facing = away[met] / distance[met][:, None]
    return points[met], normals[met], facing, np.array(found.color, np.float64)[met], distance[met]


def surface_normals(points: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Unit normals (h, w, 3) of the surface through a picture of ``points`` (h, w, 3), on the side of ``towards`` (h,
    w, 3); where neighbours tell of none, ``towards`` itself. Of the two neighbours along a row or column the nearer
    one counts, so that an edge does not lean over what is behind it."""
    along = lambda axis: _nearer_step(points, axis)
    normals = np.cross(along(0), along(1))
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    facing = towards / np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), 1e-12)
    known = np.isfinite(length) & (length > 1e-12)
    normals = np.where(known, normals / np.where(known, length, 1), facing)
    return np.where((normals * facing).sum(axis=-1, keepdims=True) < 0, -normals, normals)


def _nearer_step(points: np.ndarray, axis: int) -> np.ndarray:
    """From each point to that of its two neighbours along ``axis`` which is nearer, forwards; rows end, columns go
    around."""
    forward = np.roll(points, -1, axis) - points
    backward = points - np.roll(points, 1, axis)
    if axis == 0:
        forward[-1], backward[0] = np.nan, np.nan
    far = lambda step: np.nan_to_num(np.linalg.norm(step, axis=-1, keepdims=True), nan=np.inf)
    return np.where(far(forward) <= far(backward), forward, backward)


def farthest_point_sampling(points: np.ndarray, count: int, first: np.ndarray | None = None) -> np.ndarray:
    """Indices of up to ``count`` of ``points`` (N, 3), each the farthest from those before; the first one is the
    farthest from ``first`` (K, 3), or number 0."""
    if not len(points):
        return np.zeros(0, int)
    away = np.full(len(points), np.inf)
    if first is not None:
        away = np.linalg.norm(points[:, None] - np.atleast_2d(first)[None], axis=2).min(axis=1)
    chosen: list[int] = []
    while len(chosen) < min(count, len(points)):
        chosen.append(int(np.argmax(away)) if chosen or first is not None else 0)
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
        if away.max() <= 0:
            break
    return np.array(chosen, int)


# ---- Run ----
#
# What a report is made of: everything that is at hand of one gaze field, computed and drawn.


@dataclass(frozen=True)
class ReportPicture:
    """A PNG file, what it shows in words (``alt``) and what is said below it."""

    png: bytes
    alt: str
    caption: str


@dataclass(frozen=True, eq=False)
class Run:
    """One gaze field and what is known of it; None or empty is what is not at hand.

    ``gaze``, ``radiance``: metadata of its checkpoint and of the radiance field's; ``place``: what the place is, in a
    sentence, and its ``kind`` ("field", "scene", "hits", "mesh" or "none"). ``rays`` and ``results`` have no names of
    people but those that may be shown. ``pictures`` by what they show: "color", "gaze", "own", "sphere", "depth",
    "spread", "plan", "layout". ``stage``: the packed 3D scene (`data.pack`). ``inputs``: role, name and SHA-256 of
    each file.
    """

    title: str
    gaze: Mapping[str, Any]
    geometry_description: str
    geometry_kind: str
    radiance: Mapping[str, Any] = field(default_factory=dict)
    observer: str = ""
    rays: Rays | None = None
    summary: RaysSummary | None = None
    results: tuple[GazeResults, ...] = ()
    # Remarks on them: of another name, of an earlier version.
    warnings: tuple[str, ...] = ()
    objects: tuple[ObjectAttention, ...] = ()
    # From how many places of people objects were looked for.
    num_viewpoints: int = 0
    # Shares of objects that fewer people could see are not shown.
    min_participants: int = 1
    # For each looked-from place of people, how many people were within its radius.
    nearby_participants: tuple[int, ...] = ()
    pictures: Mapping[str, ReportPicture] = field(default_factory=dict)
    stage: str | None = None
    # How many observers, paths and points the 3D scene has.
    stage_observers: int = 0
    stage_paths: int = 0
    stage_points: int = 0
    stage_boxes: int = 0
    inputs: tuple[tuple[str, str, str], ...] = ()
    versions: Mapping[str, str] = field(default_factory=dict)
    # What the report was made with, by the option's name.
    settings: Mapping[str, str] = field(default_factory=dict)
    # Rays and people that the gaze rests on, in words, "" where that is not known.
    support_note: str = ""
    # Where all of this comes from (`figures.style`), as JSON.
    provenance_json: str = ""
    # ``objects`` of the observer alone, where one was named; of people otherwise.
    observed_objects: tuple[ObjectAttention, ...] = ()

    @property
    def provenance(self) -> Mapping[str, Any]:
        """What the gaze field was trained on and with."""
        return self.gaze.get("provenance", {})

    @property
    def verdicts(self) -> list[tuple[GazeResults, Verdict]]:
        """The verdict on each evaluation."""
        return [(r, compute_verdict(r.rows, r.split, r.num_participants, r.num_positions)) for r in self.results]


# ---- Stage ----
#
# The embedded 3D scene: what the page's own viewer (``viewer.js``) draws, packed into a few bytes a point.
#
# Positions are 16 bits an axis of the points' box, normals and colours 8 bits a component, gaze the square root of its
# share of the observer's own scale in 8 bits.

MAX_PATH_POINTS = 16_000
"""Positions of all people's paths together, at most."""

# Angle above the level from which the scene is shown at first, in radians.
_RISE = 0.85
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4)]


@dataclass(frozen=True)
class ReportCamera:
    """From where the pictures are taken: a camera at ``origin`` that looks at ``target`` (3,)."""

    origin: np.ndarray
    target: np.ndarray


@dataclass(frozen=True, eq=False)
class Stage:
    """What is drawn: the ``proxy`` of the place; ``observers`` (M, 3), of whom it has the gaze; people's ``paths``,
    (n, 3) each; ``boxes``; ``up`` (3,); the ``camera``."""

    proxy: ReportProxy
    observers: np.ndarray
    paths: Sequence[np.ndarray]
    boxes: Sequence[Region]
    up: np.ndarray
    camera: ReportCamera


def pack_stage(stage: Stage) -> str:
    """The scene as JSON that is safe within a page, its arrays in base64."""
    proxy, M = stage.proxy, len(stage.observers)
    lower, size = _frame(stage)
    place = lambda points: _bits((np.asarray(points, np.float64).reshape(-1, 3) - lower) / size, 16)
    corners = [b.vertices[a] for b in stage.boxes for e in _EDGES for a in e]
    mean = proxy.gaze.mean(axis=0, keepdims=True) if M > 1 else proxy.gaze[:0]
    gaze = np.concatenate([mean, proxy.gaze, np.zeros((int(M == 0), len(proxy.vertices)))])
    tops = np.array([_top(values) for values in gaze])
    heat = np.sqrt(np.clip(gaze / np.where(tops > 0, tops, 1)[:, None], 0, 1))
    arrays = {
        "place": place(proxy.vertices),
        "paths": place(np.concatenate([np.zeros((0, 3)), *stage.paths])),
        "boxes": place(np.array(corners)),
        "marks": place(stage.observers),
        "normal": _bits(proxy.normals * 0.5 + 0.5, 8),
        "color": np.ascontiguousarray(proxy.colors, np.uint8),
        "gaze": _bits(heat, 8),
        "map": _color_map(),
    }
    parts, start = {}, 0
    for name, array in arrays.items():
        parts[name] = [start, array.nbytes]
        start += array.nbytes
    marks = [list(range(M))] if M != 1 else []
    marks += [[k] for k in range(M)]
    ends = np.cumsum([0, *(len(p) for p in stage.paths)]).tolist()
    about = {
        "count": len(proxy.vertices),
        "lower": _rounded(lower),
        "size": _rounded(size),
        "spacing": float(f"{proxy.spacing:.6g}"),
        "up": _rounded(stage.up),
        "reach": float(f"{np.linalg.norm(size):.6g}"),
        "camera": _orbit(stage),
        "observers": [{"marks": m, "top": float(f"{top:.3g}")} for m, top in zip(marks, tops)],
        "marks": M,
        "paths": [[a, b - a] for a, b in pairwise(ends)],
        "parts": parts,
        "data": base64.b64encode(b"".join(a.tobytes() for a in arrays.values())).decode(),
    }
    return json.dumps(about, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _frame(stage: Stage) -> tuple[np.ndarray, np.ndarray]:
    """Lower corner and edges of the box that holds everything that is drawn."""
    every = [stage.proxy.vertices, stage.observers, *stage.paths, *(b.bounds for b in stage.boxes)]
    points = np.concatenate([np.reshape(p, (-1, 3)) for p in every])
    lower = points.min(axis=0).astype(np.float64)
    return lower, np.maximum(points.max(axis=0) - lower, 1e-6)


def _top(gaze: np.ndarray) -> float:
    """The end of the scale of ``gaze`` (V,): what all but a few of the points that have any stay below; 0 for none."""
    positive = gaze[gaze > 0]
    return float(np.percentile(positive, 99)) if len(positive) else 0.0


def _orbit(stage: Stage) -> dict:
    """From where the scene is shown at first: above the middle of it, on the side of the camera. The axes beside ``up``
    are made as in ``viewer.js``."""
    up = np.asarray(stage.up, float)
    east = np.cross([0.0, 1, 0] if abs(up[1]) < 0.9 else [1.0, 0, 0], up)
    east /= np.linalg.norm(east)
    # A few points lie far away from all others.
    low, high = np.percentile(stage.proxy.vertices.astype(np.float64), [3, 97], axis=0)
    back = np.subtract(stage.camera.origin, (low + high) / 2)
    turn = math.atan2(float(back @ np.cross(up, east)), float(back @ east))
    away = 1.05 * float(np.linalg.norm(high - low))
    return {"turn": float(f"{turn:.6g}"), "rise": _RISE, "away": away, "target": _rounded((low + high) / 2)}


def _bits(shares: np.ndarray, bits: int) -> np.ndarray:
    """``shares`` in 0..1 as unsigned integers, little-endian."""
    top = (1 << bits) - 1
    return np.ascontiguousarray(np.round(np.clip(shares, 0, 1) * top), "<u2" if bits == 16 else "u1")


def _color_map() -> np.ndarray:
    import matplotlib

    return np.ascontiguousarray(matplotlib.colormaps["inferno"](np.linspace(0, 1, 256))[:, :3] * 255 + 0.5, np.uint8)


def _rounded(values: np.ndarray) -> list[float]:
    return [float(f"{v:.7g}") for v in np.asarray(values, float)]
