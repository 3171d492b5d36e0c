"""Gaussian splats: a scene of many small Gaussians, each with an opacity and a view-dependent colour.

A Gaussian absorbs ``opacity exp(-r^2 / 2)`` of the light where it is densest along the ray, with r the minimum distance
from the centre in standard deviations (Kerbl et al. 2023; peak along the ray as in Moenne-Loccoz et al. 2024, "3D
Gaussian Ray Tracing"). NumPy arrays; rays are traced by `nerg_mi.transport.splat_medium`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.sphere import HARMONIC_DEGREES, SH_C0, rotate_harmonics
from nerg_mi.maths.transforms import transform_points
from nerg_mi.ranges import MAX_COORDINATE

_MIN_SCALE = 1e-9
_MIN_OPACITY = 1e-7
_BLOCK = 1 << 14  # Gaussians that are normalised in one block


@dataclass(frozen=True)
class Splats:
    """N Gaussians with activated parameters (not the raw ones of a training). float32, in the file's own frame and
    units.

    Raises `ValueError` for inconsistent shapes, non-finite numbers, and no Gaussians at all. Rotations are normalised,
    opacities clipped to [0, 1], scales to at least 1e-9.
    """

    centers: np.ndarray  # (N, 3)
    scales: np.ndarray  # Standard deviations along the Gaussian's own axes, (N, 3)
    rotations: np.ndarray  # Unit quaternions (N, 4), w first: from the Gaussian's own axes to the frame of the centres
    opacities: np.ndarray  # Fraction of light that is absorbed on a ray through the centre, (N,)
    # Coefficients of real spherical harmonics (`maths.sphere`), (N, K, 3) with K = 1, 4, 9 or 16: the colour along a
    # unit ray direction d is max(0, 1/2 + sum_k c_k Y_k(d)), in the colour space of the training.
    harmonics: np.ndarray
    extra: Mapping[str, np.ndarray] = field(default_factory=dict)  # Further columns of the file, (N,) each, by name
    color_space: str = "srgb"  # Colour space: "srgb" or "linear"
    # Assumptions of the reader, and ignored contents of the file: one sentence each.
    assumptions: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.centers)
        shapes = {"centers": (3,), "scales": (3,), "rotations": (4,), "opacities": ()}
        for name, shape in shapes.items():
            value = np.asarray(getattr(self, name), np.float32)
            if value.shape != (n, *shape):
                raise ValueError(f"the {name} of {n:,} Gaussians have the shape {value.shape}")
            object.__setattr__(self, name, value)
        colors = np.asarray(self.harmonics, np.float32)
        if colors.ndim != 3 or len(colors) != n or colors.shape[1] not in HARMONIC_DEGREES or colors.shape[2] != 3:
            raise ValueError(
                f"the harmonics of {n:,} Gaussians have the shape {colors.shape}, which is not of degree 0 to 3"
            )
        object.__setattr__(self, "harmonics", colors)
        if n == 0:
            raise ValueError("it contains no Gaussians")
        for name in (*shapes, "harmonics"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"some of the {name} of its Gaussians are not finite (a splat editor can remove them)")
        for name in ("centers", "scales"):
            if not (np.abs(getattr(self, name)) <= MAX_COORDINATE).all():
                raise ValueError(f"some of the {name} of its Gaussians are beyond {MAX_COORDINATE:g} units")
        object.__setattr__(self, "rotations", _normalize_quaternions(self.rotations))
        object.__setattr__(self, "opacities", np.clip(self.opacities, 0, 1))
        if self.scales.min() < _MIN_SCALE:
            object.__setattr__(self, "scales", np.maximum(self.scales, np.float32(_MIN_SCALE)))

    def __len__(self) -> int:
        return len(self.centers)

    @property
    def degree(self) -> int:
        """Degree of the harmonics: 0 to 3."""
        return HARMONIC_DEGREES[self.harmonics.shape[1]]

    def transform(self, to_world: Similarity) -> Splats:
        """These Gaussians in another frame, with rotated harmonics."""
        if to_world.is_identity:
            return self
        turn = to_world.matrix[:3, :3] / to_world.scale
        centers = transform_points(to_world.matrix, self.centers)
        rotations = multiply_quaternions(matrices_to_quaternions(turn), self.rotations.astype(np.float64))
        colors = rotate_harmonics(self.harmonics, turn)
        scales = self.scales * np.float32(to_world.scale)
        return replace(self, centers=centers, scales=scales, rotations=rotations, harmonics=colors)

    def axes(self) -> np.ndarray:
        """Rotation matrices (N, 3, 3), float64: columns are the Gaussians' own axes."""
        return quaternions_to_matrices(self.rotations)


def _normalize_quaternions(rotations: np.ndarray) -> np.ndarray:
    """Quaternions (N, 4) normalised to length 1. Raises `ValueError` for a quaternion of length 0."""
    unit = np.empty_like(rotations)
    # In blocks: in double precision all of them would take more memory than the Gaussians.
    for start in range(0, len(unit), _BLOCK):
        block = rotations[start : start + _BLOCK].astype(np.float64)
        length = np.linalg.norm(block, axis=1, keepdims=True)
        if not (length > 0).all():
            raise ValueError("some of its Gaussians have a rotation of length 0 (a splat editor can remove them)")
        unit[start : start + _BLOCK] = block / length
    return unit


def concatenate_splats(parts: Sequence[Splats]) -> Splats:
    """All Gaussians of ``parts``, without further columns. Raises `ValueError` for different degrees of harmonics or
    colour spaces."""
    if len({(splats.degree, splats.color_space) for splats in parts}) > 1:
        raise ValueError("its splats have harmonics of several degrees, or several colour spaces")
    names = ("centers", "scales", "rotations", "opacities", "harmonics")
    arrays = {name: np.concatenate([getattr(splats, name) for splats in parts]) for name in names}
    notes = tuple(dict.fromkeys(note for splats in parts for note in splats.notes))
    return replace(parts[0], **arrays, extra={}, notes=notes)


def splats_from_raw_parameters(
    centers: np.ndarray, log_scales: np.ndarray, rotations: np.ndarray, logits: np.ndarray, harmonics: np.ndarray
) -> Splats:
    """Splats from the raw parameters of a training: log scales, logits of opacities; quaternions w first."""
    return Splats(centers, scales_from_logs(log_scales), rotations, opacities_from_logits(logits), harmonics)


def scales_from_logs(logarithms: np.ndarray) -> np.ndarray:
    """Scales (float64) from their logarithms."""
    with np.errstate(over="ignore"):
        return np.exp(np.asarray(logarithms, np.float64))


def opacities_from_logits(logits: np.ndarray) -> np.ndarray:
    """Opacities (float64) from their logits."""
    with np.errstate(over="ignore"):
        return 1 / (1 + np.exp(-np.asarray(logits, np.float64)))


def logits_from_opacities(opacities: np.ndarray) -> np.ndarray:
    """Logits (float64) of ``opacities``; those of 0 and 1 are kept finite."""
    p = np.clip(np.asarray(opacities, np.float64), _MIN_OPACITY, 1 - _MIN_OPACITY)
    return np.log(p) - np.log1p(-p)


def harmonics_from_colors(colors: np.ndarray) -> np.ndarray:
    """Harmonics of degree 0, (N, 1, 3), for view-independent ``colors`` (N, 3)."""
    return ((np.asarray(colors, np.float64) - 0.5) / SH_C0)[:, None]


def quaternions_to_matrices(quaternions: np.ndarray) -> np.ndarray:
    """Rotation matrices (N, 3, 3), float64, of unit ``quaternions`` (N, 4), w first."""
    w, x, y, z = np.asarray(quaternions, np.float64).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def matrices_to_quaternions(rotations: np.ndarray) -> np.ndarray:
    """Quaternions (N, 4) or (4,), w first, of rotation matrices (N, 3, 3) or (3, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotations).as_quat()[..., [3, 0, 1, 2]]


def multiply_quaternions(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products (N, 4) of quaternions ``a`` and ``b`` ((4,) or (N, 4) each), w first: ``b`` is applied first, then
    ``a``."""
    aw, ax, ay, az = np.moveaxis(np.asarray(a), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(b), -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )
