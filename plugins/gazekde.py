r"""
.. _volume-gazekde:

Kernel density of tracked rays (:monosp:`gazekde`)
--------------------------------------------------

.. pluginparameters::

 * - filename
   - |string|
   - Rays file (``.npz`` or ``.parquet``) written by ``nerg rays import``. Relative names are resolved in the folder of
     the scene file.

 * - count
   - |int|
   - Number of rays, those that started nearest to the observer. (Default: 4096)

 * - kappa
   - |float|
   - Concentration of the von Mises-Fisher kernel of each ray. (Default: 20, as for the ground truth of ``nerg eval
     gaze``)

 * - to_world
   - |transform|
   - Rotation, uniform scale and translation from the rays' frame to the scene's. For the training rays of a gaze field:
     the field's own ``to_world`` combined with the similarity of ``nerg train gaze --align``, which is applied first.
     (Default: none)

Where participants near the observer looked, as a density in 1/sr: the ground truth for a gaze field (NeRG, Section
5.3). It is the ``kde`` of the integrator :ref:`nerg <integrator-nerg>`, whose AOV ``kde`` shows it on the surfaces that
the camera sees; it cannot be evaluated as a plain volume. Rays are collected once per observer. Images with at
least max(4,096, 165 x ``kappa``) pixels interpolate the density in a table (within 1e-4 of the maximum density of one
ray's kernel); smaller ones sum all rays for each pixel.

.. tabs::
    .. code-tab:: xml
        :name: gazekde-volume

        <integrator type="nerg">
            <volume type="gazekde" name="kde">
                <string name="filename" value="day.npz"/>
            </volume>
            <string name="aovs" value="kde"/>
        </integrator>

    .. code-tab:: python

        'kde': {
            'type': 'gazekde',
            'filename': 'day.npz'
        }
"""

from __future__ import annotations

import mitsuba as mi

from nerg_mi.fields.mlp import namespace
from nerg_mi.maths.geometry import Similarity
from nerg_mi.properties import read_integer, read_number, read_string, read_transform, resolve_scene_file
from nerg_mi.ranges import Range
from nerg_mi.registration import register
from nerg_mi.tracking.kde_view import KdeView
from nerg_mi.tracking.rays import Rays


class GazeKdeVolume(mi.Volume):
    __doc__ = __doc__

    def __init__(self, props, rays=None):
        super().__init__(props)
        self.filename = resolve_scene_file(read_string(props, "filename")) if rays is None else "in memory"
        count, kappa = (
            read_integer(props, "count", 4096, Range(1, 1 << 24)),
            read_number(props, "kappa", 20.0, Range(0, 1e8)),
        )
        to_world = Similarity(read_transform(props, "to_world"))
        rays = Rays.load(self.filename) if rays is None else rays
        self.rays = len(rays)
        self._view = KdeView(rays, count, kappa, to_world, namespace(mi.Float))
        self._bounds = to_world.bounds(rays.origin.min(axis=0), rays.origin.max(axis=0))

    def kde_view(self) -> KdeView:
        """The density for the integrator."""
        return self._view

    def bbox(self):
        lower, upper = self._bounds
        return mi.ScalarBoundingBox3f(lower.tolist(), upper.tolist())

    def channel_count(self):
        return 1

    def to_string(self):
        v = self._view
        return (
            f"GazeKdeVolume[\n  filename = {self.filename},\n  rays = {self.rays},\n"
            f"  count = {v.count},\n  kappa = {v.kappa}\n]"
        )


register("volume", "gazekde", GazeKdeVolume)
