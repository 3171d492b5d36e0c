"""Data of a report on one gaze field: scores, AOI attention, sampled viewpoints, and the packed 3D view."""

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

from nerg_mi.aoi.placed import Aoi, HitAssignment, assign_hits, merge_members
from nerg_mi.aoi.shares import Shares
from nerg_mi.environment.bands import render_channels
from nerg_mi.environment.environment import Environment
from nerg_mi.environment.sampler import GazeSampler, sample_field
from nerg_mi.evaluation.gaze_report import GazeResults, Verdict, compute_verdict, small_sample_factor
from nerg_mi.fields.gaze_base import GazeNetwork
from nerg_mi.figures.overlay import srgb, to_bytes
from nerg_mi.formats.boxes import Region
from nerg_mi.tracking.quality import RaysSummary
from nerg_mi.tracking.rays import Rays

# ---- Gaze at sampled viewpoints ----
#
# Gaze is evaluated in all directions from positions where participants stood. Coordinates are those of the scene.

RAYS = 50_000
"""Maximum number of samples whose hits are assigned to AOIs."""

_GOLDEN_RATIO = (math.sqrt(5) - 1) / 2
# Number of directions for the normalisation of a field. Attention shares are divided by their sum, so few are enough.
_NORMALIZATION_DIRECTIONS = 2048


@dataclass(frozen=True, eq=False)
class EyePositions:
    """Sampled viewpoints: ``positions`` (P, 3) in scene units, and the index of the participant of each, (P,)."""

    positions: np.ndarray
    participant: np.ndarray


def make_report_sampler(field: GazeNetwork, environment: Environment, kind: str = "median") -> GazeSampler:
    """Return the gaze of ``field`` in an environment, with depths of ``kind``, such as "median"."""
    return sample_field(field, environment, depth=kind, directions=_NORMALIZATION_DIRECTIONS)


def sample_eye_positions(rays: Rays, geometry: Environment, max_positions: int) -> EyePositions:
    """Sample about ``max_positions`` viewpoints from ``rays``, the same number for each participant.

    The samples of a participant are evenly spaced in time. Each participant starts at a different phase, so that the
    viewpoints cover whole recordings even if every participant contributes only one. If there are more participants
    than ``max_positions``, an evenly spaced subset of participants is used.
    """
    participants = np.unique(rays.person)
    if len(participants) > max_positions:
        participants = participants[np.linspace(0, len(participants) - 1, max_positions).astype(int)]
    per_participant, rows_of_participants = max(1, max_positions // len(participants)), []
    # Multiples of the golden ratio modulo one are evenly spread for any number of participants.
    starts = (0.5 + np.arange(len(participants)) * _GOLDEN_RATIO) % 1
    for person, start in zip(participants, starts):
        samples = np.flatnonzero(rays.person == person)
        samples = samples[np.argsort(rays.t[samples], kind="stable")]
        count = min(per_participant, len(samples))
        # One sample per interval of equal length, at the participant's phase.
        rows_of_participants.append(samples[((np.arange(count) + start) * len(samples) / count).astype(int)])
    rows = np.concatenate(rows_of_participants)
    return EyePositions(geometry.points_to_field(rays.origin[rows]), rays.person[rows])


def assign_ray_hits(
    rays: Rays,
    geometry: Environment,
    sampler: GazeSampler,
    max_rays: int,
    aois: Sequence[Aoi],
    members: Sequence[tuple[int, ...]],
    margin: float,
) -> tuple[HitAssignment, np.ndarray]:
    """Assign gaze samples to AOIs, and return the hits with the participant index of each sample (N,).

    Parameters
    ----------
    rays
        Gaze samples. Up to ``max_rays`` of them, evenly spaced, are used. A sample ends at its recorded hit point, if
        it has one, otherwise at the first surface of the scene.
    geometry
        Geometry of the scene.
    sampler
        Traces the samples in the scene.
    max_rays
        Maximum number of samples.
    aois
        Elementary AOIs.
    members
        Indices into ``aois`` of each area.
    margin
        Tolerance in scene units, as for `nerg_mi.aoi.placed.assign_hits`.
    """
    subset = rays if len(rays) <= max_rays else rays.select(np.linspace(0, len(rays) - 1, max_rays).round().astype(int))
    origins, directions = geometry.points_to_field(subset.origin), geometry.directions_to_field(subset.direction)
    trace_depth, is_hit = sampler.trace(origins, directions)
    depth = np.where(is_hit, trace_depth, np.inf)
    if subset.hit is not None:
        to_hit = geometry.points_to_field(subset.hit) - origins
        hit_distance = np.linalg.norm(to_hit, axis=1)
        has_hit = np.isfinite(hit_distance) & (hit_distance > 0)
        directions = np.where(has_hit[:, None], to_hit / np.where(has_hit, hit_distance, 1)[:, None], directions)
        depth = np.where(has_hit, hit_distance, depth)
    return merge_members(assign_hits(aois, origins, directions, depth, margin), members), subset.person


# ---- Anonymisation ----
#
# By default a report replaces the names of participants by numbered labels.


# Metadata keys that cannot contain a name.
_SAFE_METADATA = ("frame", "tracking", "source_frame", "transform", "rows_read", "preset")
# Shorter names are only replaced as whole words, since they occur within many other words.
_MIN_SUBSTRING = 3


class ParticipantLabels:
    """Numbered labels, such as "participant 1", in place of participants' names.

    Participants are numbered by their number of samples, the largest first, followed by those that only occur in
    evaluations.
    """

    def __init__(self, rays: Rays | None, results: Iterable[GazeResults] = ()):
        names: list[str] = []
        if rays is not None:
            count = np.bincount(rays.person, minlength=len(rays.persons))
            names = [rays.persons[i] for i in np.argsort(-count, kind="stable")]
        for result in results:
            names += [str(row["person"]) for row in result.participant_rows if "person" in row]
        self._number = {name: k + 1 for k, name in enumerate(dict.fromkeys(names))}
        self._label = {name: f"participant {number}" for name, number in self._number.items()}

    def label(self, name: str) -> str:
        """Return the label of the participant ``name``."""
        return self._label.get(name, "a participant")

    def number(self, name: str) -> int:
        """Return the number of the participant ``name``, 0 if unknown."""
        return self._number.get(name, 0)

    def anonymize(self, text: str) -> str:
        """Replace participants' names in ``text``, such as a file name, by their labels.

        Names are also replaced within words, except names of one or two characters.
        """
        names = sorted((n for n in self._label if n), key=len, reverse=True)
        pattern = "|".join(re.escape(n) if len(n) >= _MIN_SUBSTRING else rf"(?<!\w){re.escape(n)}(?!\w)" for n in names)
        label_of = {name.lower(): label for name, label in self._label.items()}
        replace_name = lambda match: label_of.get(match.group().lower(), "a participant")
        return re.sub(pattern, replace_name, text, flags=re.IGNORECASE) if pattern else text


def anonymize_rays(rays: Rays, labels: ParticipantLabels) -> Rays:
    """Return ``rays`` with labels in place of names, and with only the metadata that cannot contain a name."""
    metadata = {key: rays.metadata[key] for key in _SAFE_METADATA if key in rays.metadata}
    files = [d.get("file") for d in rays.metadata.get("dropped", [])]
    number = {name: f"file {k + 1}" for k, name in enumerate(dict.fromkeys(files))}
    metadata["dropped"] = [{**d, "file": number[d.get("file")]} for d in rays.metadata.get("dropped", [])]
    step_keys = ("step", "side", "kept", "of")
    metadata["steps"] = [
        {k: v for k, v in step.items() if k in step_keys or step["step"] == "fixations"}
        for step in rays.metadata.get("steps", [])
    ]
    # Sorted by label: the order of names or files could reveal them.
    order = sorted(range(len(rays.persons)), key=lambda i: labels.number(rays.persons[i]))
    code = np.empty(len(order), np.int32)
    code[order] = np.arange(len(order))
    return replace(
        rays, person=code[rays.person], persons=tuple(labels.label(rays.persons[i]) for i in order), metadata=metadata
    )


def anonymize_results(results: GazeResults, labels: ParticipantLabels) -> GazeResults:
    """Return the evaluation results with labels in place of names."""
    persons = tuple({**row, "person": labels.label(str(row.get("person", "")))} for row in results.participant_rows)
    return replace(results, participant_rows=persons)


# ---- Attention on AOIs ----
#
# Attention shares of AOIs, predicted by the field and measured from gaze samples. Every participant has the same
# weight.
#
# Intervals are 95 % confidence intervals of the mean over participants: Student's t with n - 1 degrees of freedom. For
# means this is the limit of the bootstrap over participants, widened for small numbers
# (`small_sample_factor`).

MIN_PARTICIPANTS = 3
"""Minimum number of participants for a confidence interval."""


@dataclass(frozen=True)
class MeanShare:
    """Mean attention share over participants with the 95 % confidence interval of the mean; NaN limits for too few
    participants."""

    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class ObjectAttention:
    """Attention on one AOI.

    ``name``: of the AOI; ``predicted``: predicted share of gaze at the participants' viewpoints; ``recorded``: share of
    gaze samples that hit the AOI; ``num_could_see``: participants with a viewpoint from which it is visible, or with a
    sample on it; ``num_looked``: participants with a sample on it; ``num_participants``: all participants. Values that
    need gaze samples are None without them.
    """

    name: str
    predicted: MeanShare
    recorded: MeanShare | None
    num_could_see: int | None
    num_looked: int | None
    num_participants: int | None


def summarize_objects(
    names: Sequence[str],
    shares: Shares,
    participant: np.ndarray,
    recorded: tuple[HitAssignment, np.ndarray] | None = None,
) -> tuple[ObjectAttention, ...]:
    """Summarise the attention on AOIs.

    Parameters
    ----------
    names
        Names of the AOIs.
    shares
        Predicted attention shares at P viewpoints.
    participant
        Index of the participant of each viewpoint, (P,).
    recorded
        Hits of N gaze samples and the participant index of each sample, (N,). None: viewpoints belong to no
        participant.
    """
    out = []
    for k, name in enumerate(names):
        share = shares.share[:, k]
        if recorded is None:
            out.append(
                ObjectAttention(name, MeanShare(float(share.mean()), math.nan, math.nan), None, None, None, None)
            )
            continue
        hits, person = recorded
        is_hit = np.zeros(len(person))
        is_hit[hits.rows[k]] = 1.0
        hit_share = _mean_by_participant(is_hit, person)
        seen_share = _mean_by_participant(shares.is_hit[:, k].astype(float), participant)
        field, num_participants = (
            mean_over_participants(_mean_by_participant(share, participant)),
            len(np.unique(person)),
        )
        num_seen, num_looked = int(np.sum(seen_share > 0)), int(np.sum(hit_share > 0))
        out.append(
            ObjectAttention(
                name, field, mean_over_participants(hit_share), max(num_seen, num_looked), num_looked, num_participants
            )
        )
    return tuple(out)


def mean_over_participants(values: np.ndarray) -> MeanShare:
    """Return the mean of ``values`` (N,), one per participant and within 0..1, with its confidence interval."""
    mean, n = float(values.mean()), len(values)
    if n < MIN_PARTICIPANTS:
        return MeanShare(mean, math.nan, math.nan)
    # The bootstrap's standard error uses the population variance: it divides by n, not by n - 1.
    half_width = 1.96 * float(values.std()) / math.sqrt(n) * small_sample_factor(n)
    return MeanShare(mean, max(mean - half_width, 0.0), min(mean + half_width, 1.0))


def _mean_by_participant(values: np.ndarray, person: np.ndarray) -> np.ndarray:
    """Return the mean of ``values`` for each participant that occurs."""
    _, index, count = np.unique(person, return_inverse=True, return_counts=True)
    return np.bincount(index, weights=values) / count


# ---- Scene proxy ----
#
# The 3D view draws the scene as some ten thousand points with the observers' gaze baked in. The points are sampled from
# panoramas at several viewpoints, one per small cube. Lengths are in scene units.

GazeAt = Callable[[np.ndarray, np.ndarray, float], np.ndarray]
"""``(observer (3,), points (V, 3), spacing) -> (V,)``: gaze density in 1/sr after occlusion; points are accurate to
``spacing``."""

# Points farther away than this multiple of the median distance are dropped, such as the sky or a view through a window.
_MAX_RELATIVE_DISTANCE = 5.0
# Initial number of cubes along the longest edge of the scene.
_INITIAL_CUBES = 320


@dataclass(frozen=True, eq=False)
class ReportProxy:
    """Point proxy of a scene.

    ``vertices`` (V, 3) float32; ``normals`` (V, 3), unit, towards the viewpoints; ``colors`` (V, 3) uint8 sRGB;
    ``gaze`` (M, V) of M observers in 1/sr; ``spacing``: edge length of the cube that a point represents.
    """

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
    max_points: int = 80_000,
    size: tuple[int, int] = (320, 160),
    on_panorama: Callable[[int, int], None] | None = None,
) -> ReportProxy | None:
    """Sample a point proxy of ``scene`` from panoramas; None if no panorama shows a surface.

    Parameters
    ----------
    scene : mi.Scene
        Scene whose integrator is ``nerg`` with the AOVs opacity and position.
    viewpoints
        Positions (K, 3) of the panoramas.
    up
        Up axis (3,) of the panoramas.
    observers
        Observers (M, 3) whose gaze is baked into the points.
    gaze
        Returns the gaze density of an observer at points.
    max_points
        Maximum number of points.
    size
        Width and height of the panoramas in pixels.
    on_panorama
        Called with the number of finished panoramas and their total number.
    """
    parts = []
    for number, eye in enumerate(viewpoints):
        parts.append(_render_panorama(scene, np.asarray(eye, float), np.asarray(up, float), size))
        if on_panorama is not None:
            on_panorama(number + 1, len(viewpoints))
    points, normals, facing, colors, distance = (np.concatenate(columns) for columns in zip(*parts))
    if not len(points):
        return None
    is_near = distance <= _MAX_RELATIVE_DISTANCE * np.median(distance)
    values = np.concatenate([colors, facing], axis=1)
    points, values, spacing = downsample_points(points[is_near], normals[is_near], values[is_near], max_points)
    colors, normals = values[:, :3], estimate_normals(points, values[:, 3:])
    baked = [gaze(np.asarray(observer, float), points, spacing) for observer in observers]
    heat = np.stack(baked).astype(np.float32) if baked else np.zeros((0, len(points)), np.float32)
    return ReportProxy(points.astype(np.float32), normals.astype(np.float32), to_bytes(srgb(colors)), heat, spacing)


def downsample_points(
    points: np.ndarray, normals: np.ndarray, values: np.ndarray, max_points: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Average ``points`` (N, 3) and ``values`` (N, C) within cubes, and return the means with the edge length of the
    cubes.

    The edge length is increased until at most ``max_points`` cubes are occupied. Points whose ``normals`` face opposite
    directions are averaged separately, so that the two sides of a thin wall stay apart.
    """
    edge = float(np.ptp(points, axis=0).max()) / _INITIAL_CUBES or 1.0
    side = np.argmax(np.abs(normals), axis=1)
    facing = 2 * side + (np.take_along_axis(normals, side[:, None], axis=1)[:, 0] > 0)
    while True:
        cell = np.floor((points - points.min(axis=0)) / edge).astype(np.int64)
        key = np.ravel_multi_index((*cell.T, facing), (*(cell.max(axis=0) + 1), 6))
        _, cube, count = np.unique(key, return_inverse=True, return_counts=True)
        if len(count) <= max_points:
            break
        edge *= 1.1
    mean = lambda v: np.stack([np.bincount(cube, weights=c) for c in v.T], axis=1) / count[:, None]
    return mean(points), mean(values), edge


def estimate_normals(points: np.ndarray, towards: np.ndarray, count: int = 12) -> np.ndarray:
    """Estimate unit normals (N, 3) of the surface through ``points`` (N, 3), oriented to the side of ``towards`` (N,
    3).

    A normal is the smallest principal axis of the ``count`` nearest neighbours. For fewer than three points, the
    normalised ``towards`` is returned.
    """
    from scipy.spatial import KDTree

    facing = towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    count = min(count, len(points))
    if count < 3:
        return facing
    neighbours = points[KDTree(points).query(points, k=count)[1]]
    offset = neighbours - neighbours.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))[1][:, :, 0]
    return np.where((normals * facing).sum(axis=1, keepdims=True) < 0, -normals, normals)


def _render_panorama(
    scene: Any, eye: np.ndarray, up: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Render a panorama at ``eye`` (3,), and return points, normals, directions to the viewpoint and linear colours,
    (N, 3) each, with the distances (N,)."""
    import mitsuba as mi

    level = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0])
    to_world = mi.ScalarTransform4f().look_at(origin=eye.tolist(), target=(eye + level).tolist(), up=up.tolist())
    film = {"type": "hdrfilm", "width": size[0], "height": size[1], "rfilter": {"type": "box"}}
    film |= {"component_format": "float32", "pixel_format": "rgb"}
    sensor = mi.load_dict({"type": "panorama", "to_world": to_world, "film": film})
    channels = render_channels(scene, sensor, spp=1)
    points = np.stack([channels.aovs[f"position.{axis}"] for axis in "XYZ"], axis=-1).astype(np.float64)
    is_hit = channels.mask & np.isfinite(points).all(axis=-1)
    to_eye = eye - points
    distance = np.linalg.norm(to_eye, axis=-1)
    is_hit &= distance > 0
    normals = normals_from_image(np.where(is_hit[..., None], points, np.nan), to_eye)
    facing = to_eye[is_hit] / distance[is_hit][:, None]
    return points[is_hit], normals[is_hit], facing, np.array(channels.color, np.float64)[is_hit], distance[is_hit]


def normals_from_image(points: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Compute unit normals (h, w, 3) from an image of ``points`` (h, w, 3), oriented to the side of ``towards`` (h, w,
    3).

    Derivatives use the nearer of the two neighbours along each axis, so that normals at depth discontinuities do not
    mix two surfaces. Pixels without a valid derivative get the normalised ``towards``.
    """
    step = lambda axis: _nearer_step(points, axis)
    normals = np.cross(step(0), step(1))
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    facing = towards / np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), 1e-12)
    is_known = np.isfinite(length) & (length > 1e-12)
    normals = np.where(is_known, normals / np.where(is_known, length, 1), facing)
    return np.where((normals * facing).sum(axis=-1, keepdims=True) < 0, -normals, normals)


def _nearer_step(points: np.ndarray, axis: int) -> np.ndarray:
    """Return the forward step from each point to its nearer neighbour along ``axis``; rows end at the border,
    columns wrap around."""
    forward = np.roll(points, -1, axis) - points
    backward = points - np.roll(points, 1, axis)
    if axis == 0:
        forward[-1], backward[0] = np.nan, np.nan
    step_length = lambda step: np.nan_to_num(np.linalg.norm(step, axis=-1, keepdims=True), nan=np.inf)
    return np.where(step_length(forward) <= step_length(backward), forward, backward)


def farthest_point_sampling(points: np.ndarray, count: int, first: np.ndarray | None = None) -> np.ndarray:
    """Return indices of up to ``count`` of ``points`` (N, 3) by farthest-point sampling.

    The first index is the point farthest from ``first`` (K, 3), or 0 if ``first`` is None.
    """
    if not len(points):
        return np.zeros(0, int)
    distance = np.full(len(points), np.inf)
    if first is not None:
        distance = np.linalg.norm(points[:, None] - np.atleast_2d(first)[None], axis=2).min(axis=1)
    indices: list[int] = []
    while len(indices) < min(count, len(points)):
        indices.append(int(np.argmax(distance)) if indices or first is not None else 0)
        distance = np.minimum(distance, np.linalg.norm(points - points[indices[-1]], axis=1))
        if distance.max() <= 0:
            break
    return np.array(indices, int)


# ---- Run ----
#
# All data of one report.


@dataclass(frozen=True)
class ReportPicture:
    """A PNG image with its alternative text (``alt``) and its caption."""

    png: bytes
    alt: str
    caption: str


@dataclass(frozen=True, eq=False)
class Run:
    """One gaze field with all data that a report shows; missing data is None or empty.

    ``gaze``, ``radiance``: metadata of the checkpoints; ``geometry_description``: one sentence about the
    scene, and its kind ("field", "scene", "hits", "mesh" or "none"). ``rays`` and ``results`` contain only names that
    may be shown. Keys of ``pictures``: "color", "gaze", "own", "sphere", "depth", "spread", "plan", "layout".
    ``stage``: packed 3D view (`pack_stage`). ``inputs``: role, name and SHA-256 of each file.
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
    # Warnings about the results, such as a different field name or an older version.
    warnings: tuple[str, ...] = ()
    objects: tuple[ObjectAttention, ...] = ()
    # Number of viewpoints over which the attention on AOIs is averaged.
    num_viewpoints: int = 0
    # AOIs that fewer participants could see are hidden.
    min_participants: int = 1
    # Number of participants near each viewpoint.
    nearby_participants: tuple[int, ...] = ()
    pictures: Mapping[str, ReportPicture] = field(default_factory=dict)
    stage: str | None = None
    # Numbers of observers, paths, points and boxes of the 3D view.
    stage_observers: int = 0
    stage_paths: int = 0
    stage_points: int = 0
    stage_boxes: int = 0
    inputs: tuple[tuple[str, str, str], ...] = ()
    versions: Mapping[str, str] = field(default_factory=dict)
    # Options of the report.
    settings: Mapping[str, str] = field(default_factory=dict)
    # Number of samples and participants that support the gaze, as text; "" if unknown.
    support_note: str = ""
    # Provenance (`nerg_mi.figures.style`) as JSON.
    provenance_json: str = ""
    # Attention on AOIs of the chosen observer alone; empty if none was chosen.
    observed_objects: tuple[ObjectAttention, ...] = ()

    @property
    def provenance(self) -> Mapping[str, Any]:
        """Training data and settings of the gaze field."""
        return self.gaze.get("provenance", {})

    @property
    def verdicts(self) -> list[tuple[GazeResults, Verdict]]:
        """Each evaluation with its verdict."""
        return [(r, compute_verdict(r.rows, r.split, r.num_participants, r.num_positions)) for r in self.results]


# ---- 3D view ----
#
# Data of the page's viewer (``viewer.js``), packed into a few bytes per point: positions with 16 bits per axis of the
# bounding box, normals and colours with 8 bits per component, and gaze as the square root of its fraction of the
# observer's scale in 8 bits.

MAX_PATH_POINTS = 16_000
"""Maximum number of points of all paths together."""

# Initial elevation of the camera in radians.
_INITIAL_ELEVATION = 0.85
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4)]


@dataclass(frozen=True)
class ReportCamera:
    """Camera of the report's images: ``origin`` and ``target``, (3,) each."""

    origin: np.ndarray
    target: np.ndarray


@dataclass(frozen=True, eq=False)
class Stage:
    """Content of the 3D view: ``proxy`` of the scene, ``observers`` (M, 3) whose gaze it holds, participants'
    ``paths`` (n, 3) each, AOI ``boxes``, ``up`` axis (3,) and initial ``camera``."""

    proxy: ReportProxy
    observers: np.ndarray
    paths: Sequence[np.ndarray]
    boxes: Sequence[Region]
    up: np.ndarray
    camera: ReportCamera


def pack_stage(stage: Stage) -> str:
    """Serialise the 3D view to JSON that can be embedded in a page; arrays are base64-encoded."""
    proxy, M = stage.proxy, len(stage.observers)
    lower, size = _bounding_box(stage)
    quantize_points = lambda points: _quantize((np.asarray(points, np.float64).reshape(-1, 3) - lower) / size, 16)
    corners = [b.vertices[a] for b in stage.boxes for e in _EDGES for a in e]
    mean = proxy.gaze.mean(axis=0, keepdims=True) if M > 1 else proxy.gaze[:0]
    gaze = np.concatenate([mean, proxy.gaze, np.zeros((int(M == 0), len(proxy.vertices)))])
    scale_tops = np.array([_scale_top(values) for values in gaze])
    heat = np.sqrt(np.clip(gaze / np.where(scale_tops > 0, scale_tops, 1)[:, None], 0, 1))
    arrays = {
        "place": quantize_points(proxy.vertices),
        "paths": quantize_points(np.concatenate([np.zeros((0, 3)), *stage.paths])),
        "boxes": quantize_points(np.array(corners)),
        "marks": quantize_points(stage.observers),
        "normal": _quantize(proxy.normals * 0.5 + 0.5, 8),
        "color": np.ascontiguousarray(proxy.colors, np.uint8),
        "gaze": _quantize(heat, 8),
        "map": _color_map(),
    }
    parts, start = {}, 0
    for name, array in arrays.items():
        parts[name] = [start, array.nbytes]
        start += array.nbytes
    marks = [list(range(M))] if M != 1 else []
    marks += [[k] for k in range(M)]
    ends = np.cumsum([0, *(len(p) for p in stage.paths)]).tolist()
    data = {
        "count": len(proxy.vertices),
        "lower": _round_list(lower),
        "size": _round_list(size),
        "spacing": float(f"{proxy.spacing:.6g}"),
        "up": _round_list(stage.up),
        "reach": float(f"{np.linalg.norm(size):.6g}"),
        "camera": _initial_orbit(stage),
        "observers": [{"marks": m, "top": float(f"{top:.3g}")} for m, top in zip(marks, scale_tops)],
        "marks": M,
        "paths": [[a, b - a] for a, b in pairwise(ends)],
        "parts": parts,
        "data": base64.b64encode(b"".join(a.tobytes() for a in arrays.values())).decode(),
    }
    return json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _bounding_box(stage: Stage) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower corner and the size of the bounding box of everything that is drawn."""
    arrays = [stage.proxy.vertices, stage.observers, *stage.paths, *(b.bounds for b in stage.boxes)]
    points = np.concatenate([np.reshape(p, (-1, 3)) for p in arrays])
    lower = points.min(axis=0).astype(np.float64)
    return lower, np.maximum(points.max(axis=0) - lower, 1e-6)


def _scale_top(gaze: np.ndarray) -> float:
    """Return the upper end of the scale of ``gaze`` (V,): the 99th percentile of its positive values, or 0."""
    positive = gaze[gaze > 0]
    return float(np.percentile(positive, 99)) if len(positive) else 0.0


def _initial_orbit(stage: Stage) -> dict:
    """Return the initial camera: above the centre of the scene, on the side of ``stage.camera``.

    The horizontal axes are defined as in ``viewer.js``.
    """
    up = np.asarray(stage.up, float)
    east = np.cross([0.0, 1, 0] if abs(up[1]) < 0.9 else [1.0, 0, 0], up)
    east /= np.linalg.norm(east)
    # Ignore outliers.
    low, high = np.percentile(stage.proxy.vertices.astype(np.float64), [3, 97], axis=0)
    to_camera = np.subtract(stage.camera.origin, (low + high) / 2)
    turn = math.atan2(float(to_camera @ np.cross(up, east)), float(to_camera @ east))
    away = 1.05 * float(np.linalg.norm(high - low))
    return {
        "turn": float(f"{turn:.6g}"),
        "rise": _INITIAL_ELEVATION,
        "away": away,
        "target": _round_list((low + high) / 2),
    }


def _quantize(values: np.ndarray, bits: int) -> np.ndarray:
    """Quantise values in 0..1 to unsigned little-endian integers."""
    top = (1 << bits) - 1
    return np.ascontiguousarray(np.round(np.clip(values, 0, 1) * top), "<u2" if bits == 16 else "u1")


def _color_map() -> np.ndarray:
    import matplotlib

    return np.ascontiguousarray(matplotlib.colormaps["inferno"](np.linspace(0, 1, 256))[:, :3] * 255 + 0.5, np.uint8)


def _round_list(values: np.ndarray) -> list[float]:
    return [float(f"{v:.7g}") for v in np.asarray(values, float)]
