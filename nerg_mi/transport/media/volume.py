"""Any Mitsuba volumes as a medium that is marched."""

from __future__ import annotations

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.field.backend import namespace
from nerg_mi.maths.ray_box import intersect_box
from nerg_mi.transport.fingerprint import Fingerprint
from nerg_mi.transport.freezing import recording

from .cells import bound, describe
from .protocol import LocalRay, bounded


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
        return bounded(self._density.eval_1(self._at(p), active))

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
