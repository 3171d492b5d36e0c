r"""
.. _volume-splats:

Gaussian splats (:monosp:`splats`)
----------------------------------

.. pluginparameters::

 * - filename
   - |string|
   - Gaussian splats as 3DGS ``.ply`` (any order of columns, with or without normals), ``.splat``, ``.spz`` of version 1
     to 3, or ``.glb`` with KHR_gaussian_splatting. Relative names are looked up beside the scene file.

 * - to_world
   - |transform|
   - A rotation, a uniform scale and a translation that place the splats in the scene; colours that depend on direction
     turn with them. (Default: none)

 * - color_space
   - |string|
   - What the colours are that their harmonics give: ``srgb``, as photos train them, ``linear``, or what the ``file``
     says, which only ``.glb`` does: the others are sRGB. (Default: ``file``)

 * - extent
   - |float|
   - Where Gaussians are cut off, in standard deviations. (Default: 3)

 * - centers, scales, rotations, opacities, harmonics
   - |tensor|
   - What the Gaussians are, each flat: 3, 3, 4 (quaternion, w first), 1 and 3 (degree + 1)² numbers a Gaussian.
   - |exposed|, |differentiable|

A place as many small Gaussians, as most photogrammetry gives it today: the ``field`` of the integrator
:ref:`nerg <integrator-nerg>`, which gives of it all that it gives of a trained field. It is no volume for other
plugins, since splats have no density at a point.

A ray meets a Gaussian where it is nearest to its centre by the Gaussian's own measure, and loses there the share
:math:`\alpha = \min(o\,e^{-r^2/2}, 0.9999)` of its light, :math:`r` that distance in standard deviations and :math:`o`
the opacity. Gaussians are met in the order of these peaks, ray by ray, so that nothing pops as the camera turns;
cameras and observers may stand inside of them. Colours are composited in their colour space and then made linear.

Depth is that of the peaks: ``expected`` their mean, ``median`` (and ``refined``) the peak at which half of the ray's
own opacity is reached. Of the parameters of a march only ``stop`` applies (here 1e-4 by default), and ``step``, by
which the tolerance of occlusion is measured: by default the median thickness of the Gaussians.

Derivatives reach the Gaussians, cameras and observers as those of a trained field do, with memory that does not grow
with the number of hits. They do not see which Gaussians a ray meets, nor in which order.

.. tabs::
    .. code-tab:: xml
        :name: splats-volume

        <volume type="splats" name="field">
            <string name="filename" value="store.ply"/>
        </volume>

    .. code-tab:: python

        'field': {
            'type': 'splats',
            'filename': 'store.ply'
        }
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from nerg_mi.errors import NergError
from nerg_mi.fields.mlp import namespace
from nerg_mi.fields.splats import Splats
from nerg_mi.formats.splats import read_splats
from nerg_mi.maths.geometry import Similarity
from nerg_mi.properties import read_choice, read_number, resolve_scene_file, read_string, read_transform, make_volume_class
from nerg_mi.ranges import Range
from nerg_mi.registration import register
from nerg_mi.transport.jit import recording
from nerg_mi.transport.splat_medium import SplatArrays, SplatMedium


class SplatsVolume(make_volume_class()):
    __doc__ = __doc__
    plugin = "splats"

    def __init__(self, props, splats=None):
        # ``splats``: Gaussians in memory in place of a file; see ``of``.
        self._similarity = Similarity(read_transform(props, "to_world"))
        color_space = read_choice(props, "color_space", "file", ("file", "srgb", "linear"))
        extent = read_number(props, "extent", 3, Range(0.1, 10))
        self.filename = "" if splats is not None else resolve_scene_file(read_string(props, "filename"))
        super().__init__(props)
        self.splats = splats if splats is not None else read_splats(self.filename)
        for note in (*self.splats.assumptions, *self.splats.notes):
            log: Any = mi.Log  # of which the stubs know nothing
            log(mi.LogLevel.Warn, f"{self.filename}: {note}")
        self.color_space = self.splats.color_space if color_space == "file" else color_space
        self.field = SplatArrays(self.splats, namespace(mi.Float), extent)

    @staticmethod
    def check(network: Splats) -> None:
        if not isinstance(network, Splats):
            raise NergError(f"splats in memory are needed, got {type(network).__name__}; read them from their file")

    def medium(self) -> SplatMedium:
        """The splats as rays meet them."""
        return SplatMedium(self.field, self._similarity, self.color_space)

    def eval_1(self, it, active=True):
        raise NergError('"splats" have no density at a point: give them to "nerg" as its "field"')

    def parameters_changed(self, keys=()):
        if recording():
            raise NergError(
                "the Gaussians cannot be changed inside of a function that dr.freeze records, as their tree is built "
                "outside of kernels: call params.update() before the function"
            )
        super().parameters_changed(keys)

    def describe(self):
        lower, upper = self.bounds()
        return {
            "filename": self.filename,
            "count": len(self.splats),
            "degree": self.splats.degree,
            "bbox": f"{lower.round(4).tolist()} to {upper.round(4).tolist()}",
            "color_space": self.color_space,
        }


register("volume", "splats", SplatsVolume)
