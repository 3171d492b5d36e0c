r"""
.. _volume-nerf:

Trained radiance field (:monosp:`nerf`)
---------------------------------------

.. pluginparameters::

 * - filename
   - |string|
   - Checkpoint (safetensors) written by ``nerg train radiance`` or ``nerg_mi.formats.fields.save_radiance``.
     Relative names are looked up beside the scene file.

 * - to_world
   - |transform|
   - A rotation, a uniform scale and a translation that place the field in the scene. Under a scale of :math:`s` the
     density becomes :math:`\sigma / s`, so that opacities do not change. (Default: none)

 * - grid.table, density_net.0, ..., color_net.0, ...
   - |tensor|
   - Hash grid features and the weight matrices of both networks.
   - |exposed|, |differentiable|

Density and view-dependent colour of a place, as a multiresolution hash grid with two small networks. It is meant as the
``field`` of the integrator :ref:`nerg <integrator-nerg>`. As a plain volume it returns the density, in 1 / scene unit,
through ``eval_1``: 0 outside of ``bbox()``, and in the cells that the checkpoint's occupancy grid calls empty, which are
vacuum by definition: training has left them unsampled, and whatever the networks say there is skipped when marching. (A plain volume is not told the direction that its colour depends on.)

.. tabs::
    .. code-tab:: xml
        :name: nerf-volume

        <volume type="nerf" name="field">
            <string name="filename" value="store.safetensors"/>
        </volume>

    .. code-tab:: python

        'field': {
            'type': 'nerf',
            'filename': 'store.safetensors'
        }
"""

from __future__ import annotations

import mitsuba as mi

from nerg_mi.field.backend import namespace
from nerg_mi.formats.fields import load_radiance
from nerg_mi.properties import text
from nerg_mi.registration import register
from nerg_mi.transport.media import FieldMedium, Similarity


class NerfVolume(mi.Volume):
    __doc__ = __doc__

    def __init__(self, props):
        super().__init__(props)
        self.filename = str(mi.file_resolver().resolve(text(props, "filename")))
        to_world = props.get("to_world", mi.ScalarTransform4f())
        self.field, self.metadata = load_radiance(self.filename, namespace(mi.variant()))
        self._similarity = Similarity(to_world.matrix)

    def medium(self) -> FieldMedium:
        """The field as the marcher sees it."""
        return FieldMedium(self.field, self._similarity)

    def bbox(self):
        lower, upper = self.medium().bounds()
        return mi.ScalarBoundingBox3f(lower.tolist(), upper.tolist())

    def channel_count(self):
        return 1

    def eval_1(self, it, active=True):
        return self.medium().occupied_density(self._similarity.point_to_local(it.p), active)

    def traverse(self, cb):
        for name, value in self.field.parameters().items():
            cb.put(name, value, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys=()):
        self.field.pack()

    def to_string(self):
        c = self.field.config
        lower, upper = self.medium().bounds()
        return (
            f"NerfVolume[\n  filename = {self.filename},\n"
            f"  grid = {c.grid.levels} x {c.grid.features}, 2^{c.grid.log2_rows} rows, "
            f"{c.grid.base} to {c.grid.finest},\n"
            f"  networks = {c.density_sizes}, {c.color_sizes},\n"
            f"  bbox = {lower.round(4).tolist()} to {upper.round(4).tolist()},\n"
            f"  color_space = {self.field.color_space}\n]"
        )


register("volume", "nerf", NerfVolume)
