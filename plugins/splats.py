r"""
.. _volume-splats:

Gaussian splats (:monosp:`splats`)
----------------------------------

.. pluginparameters::

 * - filename
   - |string|
   - Gaussian splats as 3DGS ``.ply`` (any order of columns, with or without normals), ``.splat``, ``.spz`` of version 1
     to 3, ``.sog`` of version 2, or ``.glb`` with KHR_gaussian_splatting. Relative names are resolved in the folder of
     the scene file.

 * - to_world
   - |transform|
   - Rotation, uniform scale and translation of the splats in the scene; view-dependent colours are rotated, too.
     (Default: none)

 * - color_space
   - |string|
   - Colour space of the harmonics: ``srgb``, as trained from photos, ``linear``, or that of the ``file``, which only
     ``.glb`` specifies (otherwise sRGB). (Default: ``file``)

 * - extent
   - |float|
   - Cut-off radius of Gaussians in standard deviations. (Default: 3)

 * - lists
   - |bool|
   - Whether rays of a camera or an observer may read lists of Gaussians (see below). (Default: true)

 * - centers, scales, rotations, opacities, harmonics
   - |tensor|
   - Parameters of the Gaussians, flat: 3, 3, 4 (quaternion, w first), 1 and 3 (degree + 1)² numbers per Gaussian.
   - |exposed|, |differentiable|

A scene of many small Gaussians, the output of most current photogrammetry: a ``field`` of the integrator :ref:`nerg
<integrator-nerg>`, which computes the same quantities as for a radiance field. It cannot be used by other plugins,
since splats have no density at a point.

A Gaussian acts where it is densest along the ray. It absorbs the fraction :math:`\alpha = \min(o\,e^{-r^2/2}, 0.9999)`
of the light there, with the distance :math:`r` from its centre in standard deviations and the opacity :math:`o`.
Gaussians are sorted by these peaks for each ray, so that nothing pops as the camera turns; cameras and observers may be
inside them. Colours are composited in their colour space and then converted to linear.

Depth refers to the peaks: ``expected`` is their mean, ``median`` (and ``refined``) the peak at which half of the ray's
own opacity is reached. Of the march parameters only ``stop`` applies (default here: 1e-4), and ``step``, which sets the
tolerance of occlusion (default: the median thickness of the Gaussians).

With 4,096 Gaussians or more, rays of perspective, thin-lens and orthographic cameras, panoramas and observers read
lists of the Gaussians in their part of the image, as rasterisers do, instead of searching a tree, in a third to a
tenth of the time. Three things differ. Gaussians are sorted by the distances of their centres from the camera
(orthographic: along its axis), and by their peaks only among each nine successive ones. Colours are those in the
directions of the centres, from the middle of a lens, as in 3DGS. Gaussians that absorb less than 1/255 of the light
are left out. Other rays, such as batches of random pixels of several cameras, and functions that ``dr.freeze`` records
use the tree, and so do lenses that blur so many Gaussians so far that their lists would have more than 33 million
entries.

Derivatives reach the Gaussians, cameras and observers as for a radiance field, from the lists or the tree that the rays
read, with memory that does not grow with the number of hits. They ignore changes of the set of Gaussians along a ray
and of their order.

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
from nerg_mi.properties import (
    make_volume_class,
    read_boolean,
    read_choice,
    read_number,
    read_string,
    read_transform,
    resolve_scene_file,
)
from nerg_mi.ranges import Range
from nerg_mi.registration import register
from nerg_mi.transport.jit import is_recording
from nerg_mi.transport.splat_medium import SplatArrays, SplatMedium


class SplatsVolume(make_volume_class()):
    __doc__ = __doc__
    plugin = "splats"

    def __init__(self, props, splats=None):
        # ``splats``: Gaussians in memory instead of a file; see ``from_network``.
        self.similarity = Similarity(read_transform(props, "to_world"))
        color_space = read_choice(props, "color_space", "file", ("file", "srgb", "linear"))
        extent = read_number(props, "extent", 3, Range(0.1, 10))
        self.may_list = read_boolean(props, "lists", True)
        self.filename = "" if splats is not None else resolve_scene_file(read_string(props, "filename"))
        super().__init__(props)
        self.splats = splats if splats is not None else read_splats(self.filename)
        for note in (*self.splats.assumptions, *self.splats.notes):
            log: Any = mi.Log  # missing in the stubs
            log(mi.LogLevel.Warn, f"{self.filename}: {note}")
        self.color_space = self.splats.color_space if color_space == "file" else color_space
        self.field = SplatArrays(self.splats, namespace(mi.Float), extent)

    @staticmethod
    def check(network: Splats) -> None:
        if not isinstance(network, Splats):
            raise NergError(f"expected splats in memory, got {type(network).__name__}; read them from their file first")

    def medium(self) -> SplatMedium:
        """The splats as a medium."""
        return SplatMedium(self.field, self.similarity, self.color_space, self.may_list)

    def eval_1(self, it, active=True):
        raise NergError('"splats" have no density at a point; use them as the "field" of "nerg"')

    def parameters_changed(self, keys=()):
        if is_recording():
            raise NergError(
                "Gaussians cannot change inside a function that dr.freeze records, since their tree is built outside "
                "of kernels; call params.update() before the function"
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
