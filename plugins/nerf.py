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

 * - max_density
   - |float|
   - For Mitsuba's own media only, which need a bound: what ``eval_1`` returns at most, in 1 / scene unit. Times the
     longest way through the box it should stay below 50: a path tracer's work grows with it, and more is opaque anyway.
     :ref:`nerg <integrator-nerg>` knows nothing of it. (Default: 0, no bound, and no use in media)

 * - constant_weights
   - |bool|
   - Write the weights of the networks into the kernels, for many large frames of one field: the same pictures to the
     bit in less time, after some seconds of compilation for each size of picture (docs/explanation/performance.md, "Weights as
     constants"). Only on processors, and where nothing is differentiated; weights that change often are not for it.
     (Default: false)

 * - grid.table, density_net.0, ..., color_net.0, ...
   - |tensor|
   - Features of the grid and the weight matrices of both networks.
   - |exposed|, |differentiable|

Density and view-dependent colour of a place, as a multiresolution hash grid with two small networks. The second is
asked for the colour of every sample of a ray; of a checkpoint that was trained so (``nerg train radiance --deferred``)
once a ray, with the mean of what the first says of its samples (Hedman et al. 2021). It is meant as the ``field`` of
the integrator :ref:`nerg <integrator-nerg>`. As a plain volume it returns the density, in 1 / scene unit,
through ``eval_1``: 0 outside of ``bbox()``, and in the cells that the checkpoint's occupancy grid calls empty, which
are vacuum by definition: training has left them unsampled, and whatever the networks say there is skipped when
marching. With ``max_density`` it serves as ``sigma_t`` of a ``heterogeneous`` medium. (A plain volume is not told the
direction that its colour depends on.)

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

from typing import Any

import drjit as dr
import mitsuba as mi

from nerg_mi.errors import NergError
from nerg_mi.fields.mlp import namespace, set_constant_weights
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.formats.fields import load_radiance
from nerg_mi.maths.geometry import Similarity
from nerg_mi.properties import read_boolean, read_number, load_network, read_transform, make_volume_class
from nerg_mi.ranges import POSITIVE_VALUES, Range
from nerg_mi.registration import register
from nerg_mi.transport.field_medium import FieldMedium


class NerfVolume(make_volume_class()):
    __doc__ = __doc__
    plugin = "nerf"

    def __init__(self, props, network=None):
        # ``network``: a field in memory in place of a file; see ``of``.
        similarity = Similarity(read_transform(props, "to_world"))
        field, metadata, filename = load_network(props, network, load_radiance, namespace(mi.Float))
        # Mitsuba's own media ask the base class, not bbox(): it makes its box from the unit cube.
        lower, upper = similarity.bounds(field.box.lower, field.box.upper)
        props["to_world"] = mi.ScalarTransform4f().translate(lower.tolist()).scale((upper - lower).tolist())
        super().__init__(props)
        self.filename, self.field, self.metadata, self._similarity = filename, field, metadata, similarity
        self.max_density = read_number(props, "max_density", 0, Range(0, POSITIVE_VALUES.high))
        if read_boolean(props, "constant_weights", False):
            set_constant_weights(field)

    @staticmethod
    def check(network: RadianceField) -> None:
        if not isinstance(network, RadianceField):
            raise NergError(
                f"a radiance field in memory is needed, got {type(network).__name__}; load one from its file"
            )

    def medium(self) -> FieldMedium:
        """The field as the marcher sees it."""
        return FieldMedium(self.field, self._similarity)

    def eval_1(self, it: Any, active: Any = True):
        sigma = self.medium().occupied_density(self._similarity.point_to_local(it.p), active)
        return dr.minimum(sigma, self.max_density) if self.max_density else sigma

    def max(self):
        if not self.max_density:
            raise NergError(
                f'a medium needs a bound on the density of "{self.filename}": give the volume a "max_density"'
            )
        return self.max_density

    def resolution(self):
        cells = int(self.field.config.grid.finest)
        return mi.ScalarVector3i(cells, cells, cells)

    def describe(self):
        c, (lower, upper) = self.field.config, self.bounds()
        return {
            "filename": self.filename,
            "grid": c.grid.describe(),
            "networks": f"{c.density_sizes}, {c.color_sizes}{' (once a ray)' if c.deferred else ''}",
            "bbox": f"{lower.round(4).tolist()} to {upper.round(4).tolist()}",
            "color_space": self.field.color_space,
        }


register("volume", "nerf", NerfVolume)
