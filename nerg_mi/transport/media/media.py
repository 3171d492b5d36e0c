"""What the marcher asks of a place: its extent, its density and its colour.

A trained field and any pair of Mitsuba volumes answer the same questions, so that
analytic cases, grids from other tools and neural fields run through one code path.
Rays are handed over once (``local``), then every sample is ``o + t d`` in the
medium's own coordinates while ``t`` stays the distance in the scene.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.field.backend import namespace
from nerg_mi.field.radiance import RadianceField
from nerg_mi.maths.ray_box import intersect_box
from nerg_mi.transport.fingerprint import Fingerprint
from nerg_mi.transport.freezing import recording

from .cells import bound, describe

MAX_DENSITY = 1e30
"""Infinite densities count as this one, which is opaque over any length."""


class Similarity:
    """A rotation, uniform scale and translation: a field's ``to_world``.

    ``matrix``: (4, 4), field to scene. Raises ``NergError`` when it shears, mirrors or scales
    unevenly: densities and directions would then have no single scale.
    """

    def __init__(self, matrix=None):
        m = np.eye(4) if matrix is None else np.asarray(matrix, float)
        linear = m[:3, :3]
        determinant = np.linalg.det(linear) if np.all(np.isfinite(m)) else np.nan
        scale = abs(determinant) ** (1 / 3)
        if not (
            determinant > 0
            and np.array_equal(m[3], [0, 0, 0, 1])
            and np.allclose(linear @ linear.T, scale**2 * np.eye(3), atol=1e-4 * scale**2)
        ):
            raise NergError(
                '"to_world" of a field must be a rotation, a uniform scale and a translation; bake any other '
                "transform into the field's training data"
            )
        self.matrix, self.scale = m, float(scale)
        self.inverse = np.linalg.inv(m)
        self.identity = bool(np.array_equal(m, np.eye(4)))

    def point_to_local(self, p):
        return p if self.identity else self._apply(self.inverse, p, 1)

    def vector_to_local(self, v):
        """A scene vector in field coordinates; a unit vector becomes 1 / scale long."""
        return v if self.identity else self._apply(self.inverse, v, 0)

    def direction_to_local(self, v):
        """A unit scene direction as a unit field direction."""
        return v if self.identity else self._apply(self.inverse * self.scale, v, 0)

    def bounds(self, lower, upper):
        """Scene-space axis-aligned bounds of a field-space box."""
        corners = np.array(
            [[x, y, z, 1] for x in (lower[0], upper[0]) for y in (lower[1], upper[1]) for z in (lower[2], upper[2])]
        )
        p = (corners @ self.matrix.T)[:, :3]
        return p.min(0), p.max(0)

    @staticmethod
    def _apply(m, v, w):
        rows = [dr.fma(a, v.x, dr.fma(b, v.y, dr.fma(c, v.z, w * e))) for a, b, c, e in m[:3].tolist()]
        return type(v)(*rows)


@dataclass
class LocalRay:
    """A ray in a medium's coordinates: point ``o + t d`` at scene distance ``t``; ``w`` is the unit direction."""

    o: object
    d: object
    w: object
    t_near: object
    t_far: object


def _bounded(sigma):
    # A negative value of an interpolated or fitted grid would create light; comparing also drops NaN.
    return dr.select(sigma > 0, dr.minimum(sigma, MAX_DENSITY), 0)


class FieldMedium:
    """A radiance field placed in the scene."""

    def __init__(self, field: RadianceField, to_world: Similarity | None = None):
        self.field, self.to_world = field, to_world or Similarity()
        # A field scaled by s is s times longer, so its density per scene unit is s times lower.
        self._per_unit = 1 / self.to_world.scale
        self.occupancy = field.occupancy
        self.color_space = field.color_space
        self.has_color = True
        self.cells = None

    @property
    def length_scale(self) -> float:
        """Diagonal of the medium in scene units."""
        return self.field.box.diagonal * self.to_world.scale

    @property
    def step(self) -> float | None:
        """Step length in scene units that suits the medium, if it knows one."""
        return None if self.field.march_step is None else self.field.march_step * self.to_world.scale

    def bounds(self):
        return self.to_world.bounds(self.field.box.lower, self.field.box.upper)

    def parameters(self) -> list:
        """Arrays that densities and colours depend on, for derivatives."""
        return self.field.kernel_parameters()

    def local(self, o, d) -> LocalRay:
        o_l, d_l = self.to_world.point_to_local(o), self.to_world.vector_to_local(d)
        near, far = intersect_box(o_l, d_l, self.field.box.lower, self.field.box.upper)
        return LocalRay(o_l, d_l, self.to_world.direction_to_local(d), near, far)

    @property
    def feature_count(self) -> int:
        """Geometry features of a point, which ``density_features`` returns."""
        return self.field.config.geometry

    def to_local(self, p):
        """Scene points in the field's coordinates."""
        return self.to_world.point_to_local(p)

    def to_unit(self, p):
        """Occupancy-grid coordinates (unit cube) of local points."""
        return self.field.box.to_unit(p)

    def vector_to_unit(self, v):
        return v / self.field.box.side

    def density(self, p, active):
        return _bounded(self.field.density(p, active) * self._per_unit)

    def occupied_density(self, p, active):
        """Density where no march has looked up the occupancy grid before: 0 in its empty cells."""
        if self.occupancy is not None:
            active = active & (self.occupancy.empty_cells(self.to_unit(p), active) == 0)
        return dr.select(active, self.density(p, active), 0)

    def density_features(self, p, active):
        """Density, and what ``color`` needs of the same point."""
        sigma, features = self.field.density_features(p, active)
        return _bounded(sigma * self._per_unit), features

    def color(self, features, p, w, active):
        """Colour in ``color_space`` (Array3f)."""
        return self.field.color(features, w)

    def background(self, o, d):
        """Colour behind the field of scene rays, in ``color_space``; None for a field without a background network."""
        if self.field.background is None:
            return None
        return self.field.background(self.to_world.point_to_local(o), self.to_world.direction_to_local(d))


class VolumeMedium:
    """Any Mitsuba volume as density (1/scene unit), optionally with a second one as colour.

    Outside of the density volume's ``bbox()`` there is vacuum. Empty voxels of an axis-aligned
    ``gridvolume`` are skipped, under the bound that its voxels give; any other volume states no bound and
    is marched unskipped. Colours are spectra of the variant in use.
    """

    color_space = "spectrum"

    def __init__(self, density, color=None):
        import mitsuba as mi

        self._interaction, self._variant = mi.Interaction3f, mi.variant()
        self._density, self._color = density, color
        self.has_color = color is not None
        box = density.bbox()
        self._lower, self._upper = np.array(box.min, float), np.array(box.max, float)
        if not np.all(np.isfinite(self._lower) & np.isfinite(self._upper)) or np.any(self._upper <= self._lower):
            raise NergError(
                f'the volume "density" has no finite extent (its bounding box is {self._lower} to {self._upper}); '
                "give it a to_world that places it in the scene"
            )
        self._read: Fingerprint | None = None
        self.refresh()

    def refresh(self, anyway: bool = False) -> None:
        """Read the grid's voxels again if they are other arrays than before, or ``anyway``; call after they may have
        changed."""
        if recording():
            # A bound would be that of these voxels, and not of those of the replays.
            self._bound = self._read = None
            return
        import mitsuba as mi

        arrays = Fingerprint(v for v in dict(mi.traverse(self._density)).values() if dr.is_array_v(v))
        if arrays == self._read and not anyway:
            return
        described = describe(self._density)
        self.cells, self._bound, self.step = None, None, None
        if described is not None:
            self.cells, data = described
            # A step that is longer than a voxel can pass over a sheet.
            self.step = min(self.length_scale / 1024, 0.5 * self.cells.edge)
            self._bound = bound(data, namespace(self._variant))
        # At the end: what was refused is looked at again.
        self._read = arrays

    @property
    def occupancy(self):
        """Where there may be density; None while derivatives of it are tracked, which empty voxels have too."""
        if self._bound is None or any(dr.grad_enabled(v) for v in self.parameters()):
            return None
        return self._bound

    @property
    def length_scale(self) -> float:
        return float(np.linalg.norm(self._upper - self._lower))

    def bounds(self):
        return self._lower, self._upper

    def parameters(self) -> list:
        """Arrays that densities and colours depend on, for derivatives."""
        import mitsuba as mi

        values = []
        for volume in (self._density, self._color):
            if volume is not None:
                values += [v for v in dict(mi.traverse(volume)).values() if dr.is_array_v(v) and dr.is_float_v(v)]
        return values

    def local(self, o, d) -> LocalRay:
        near, far = intersect_box(o, d, self._lower, self._upper)
        return LocalRay(o, d, d, near, far)

    def to_unit(self, p):
        """Occupancy-grid coordinates (the volume as the unit cube) of points."""
        return (p - type(p)(*self._lower.tolist())) * self._inverse_size(p)

    def vector_to_unit(self, v):
        return v * self._inverse_size(v)

    def _inverse_size(self, v):
        return type(v)(*(1 / (self._upper - self._lower)).tolist())

    def _at(self, p):
        it = dr.zeros(self._interaction)
        it.p = p
        return it

    def density(self, p, active):
        return _bounded(self._density.eval_1(self._at(p), active))

    def density_features(self, p, active):
        return self.density(p, active), []

    def color(self, features, p, w, active):
        return self._color.eval(self._at(p), active)

    def background(self, o, d):
        return None


class KnownEmpty:
    """What a ``VolumeMedium`` skips, as dr.freeze finds it among an integrator's attributes. (The medium itself is
    handed to custom operations, which would have to make another one of its kind.)"""

    DRJIT_STRUCT = {"bound": None}

    def __init__(self, medium: VolumeMedium):
        self.medium = medium

    @property
    def bound(self):
        return self.medium._bound

    @bound.setter
    def bound(self, value):
        self.medium._bound = value


class GazeMedium:
    """A gaze field placed in the scene. Densities over directions do not change with scale.

    A normalised field must ``face`` an observer before it is evaluated for one.
    """

    def __init__(self, field, to_world: Similarity | None = None):
        self.field, self.to_world = field, to_world or Similarity()
        self._integrals, self._recorded = [], False

    @property
    def networks(self) -> int:
        """Networks that one evaluation of gaze evaluates: emit's, capture's, or both."""
        return 2 if self.field.config.variant == "emit_capture" else 1

    def parameters(self) -> list:
        """Arrays that gaze depends on, for derivatives."""
        return list(self.field.parameters().values())

    def face(
        self, observers: list, place, settings, kind: str, surface_opacity: float, like: GazeMedium | None = None
    ) -> None:
        """Integrate a normalised field over the spheres of ``observers`` (Point3f, one lane each) in ``place``; of
        another one nothing needs to be known.

        ``settings``, ``kind``, ``surface_opacity``: of the observers' rays. Kept for as long as neither of them
        changes.
        ``like``: a medium of the same box, place and kind of field that faces the same observers, whose depths will do.
        """
        from nerg_mi.transport.observer.integral import GazeIntegral

        if not self.field.config.normalized:
            return
        how = place, settings, kind, surface_opacity
        # What was made while a function was recorded is the recording's.
        known = [] if recording() or self._recorded else self._integrals
        self._recorded = recording()
        depths = [None] * len(observers) if like is None else like._integrals
        self._integrals = [
            next((k for k in known if k.serves(p_o, *how)), None)
            or GazeIntegral(self, place, p_o, *how[1:], depths=traced)
            for p_o, traced in zip(observers, depths)
        ]

    def known(self) -> list:
        """Of the observers that are faced, the integrals as numbers, for ``recall``: without the directions that they
        are over."""
        from nerg_mi.transport.observer.integral import KnownIntegral

        return [KnownIntegral(k.center, k.value()) for k in self._integrals]

    def recall(self, known: list) -> None:
        """Face the observers of ``known`` again. Only for as long as neither the field nor its place has changed."""
        self._integrals = list(known)

    def unnormalized(self, p_od, p_o, r_o, active, escaped=False):
        """``(emit, capture)`` of a normalised field, whose product is what is integrated."""
        local = self.to_world
        return self.field.unnormalized(
            local.point_to_local(p_od),
            local.point_to_local(p_o),
            local.direction_to_local(r_o),
            active,
            escaped=escaped,
        )

    def evaluate(self, p_od, p_o, r_o, active, semantic=None, escaped=False):
        """``(gaze, emit, capture)`` for scene points and the unit scene direction ``r_o``; ``semantic`` as the field
        wants it;
        ``escaped``: directions in which no surface is met."""
        local = self.to_world
        return self.field.evaluate(
            local.point_to_local(p_od),
            local.point_to_local(p_o),
            local.direction_to_local(r_o),
            active,
            semantic,
            self._integral(p_o),
            escaped,
        )

    def _integral(self, p_o):
        """Of the observer that is faced nearest to ``p_o``, lane by lane."""
        return at_nearest(self._integrals, p_o, lambda known: known.value()) if self._integrals else None


def at_nearest(known: list, p_o, of):
    """``of(k)`` of that one ``k`` of ``known``, each with a ``center``, which is nearest to ``p_o``, lane by lane."""
    best, apart = of(known[0]), None
    for k in known if len(known) > 1 else ():
        here = dr.detach(dr.squared_norm(p_o - k.center))
        best = best if apart is None else dr.select(here < apart, of(k), best)
        apart = here if apart is None else dr.minimum(here, apart)
    return best
