r"""
.. _volume-nerf:

Radiance field (:monosp:`nerf`)
-------------------------------

.. pluginparameters::

 * - filename
   - |string|
   - Checkpoint (safetensors) written by ``nerg train radiance`` or ``nerg_mi.formats.fields.save_radiance``. Relative
     names are resolved in the folder of the scene file.

 * - to_world
   - |transform|
   - Rotation, uniform scale and translation of the field in the scene. A scale of :math:`s` turns density into
     :math:`\sigma / s`, so that opacities do not change. (Default: none)

 * - max_density
   - |float|
   - Upper bound of ``eval_1`` in 1/scene unit, for Mitsuba's own media, which require one. Its product with the longest
     path through the box should stay below 50: the cost of a path tracer grows with it, and larger values are opaque
     anyway. Not used by :ref:`nerg <integrator-nerg>`. (Default: 0, no bound; the volume cannot be used in media)

 * - constant_weights
   - |bool|
   - Write the weights of the networks into the kernels as literals: bit-identical images in less time, after some
     seconds of compilation for each image size (docs/explanation/performance.md, "Weights as constants"). For many
     large frames of one field; only on CPUs, without derivatives, and for weights that rarely change. (Default: false)

 * - grid.table, density_net.0, ..., color_net.0, ...
   - |tensor|
   - Features of the grid and weight matrices of both networks.
   - |exposed|, |differentiable|

 * - voxels.log_density, voxels.color_basis
   - |tensor|
   - Log densities of a compiled field (``nerg compile``), which replace the density of its networks, and the functions
     of the direction of its stored colours. They are discarded when the grid or a network changes.
   - |exposed|, |differentiable|

Density and view-dependent colour of a scene: a multiresolution hash grid with two small networks. The colour network is
evaluated at each sample of a ray; for a checkpoint with deferred shading (``nerg train radiance --deferred``) once per
ray, on the mean features of its samples (Hedman et al. 2021). The volume is meant as the ``field`` of the integrator
:ref:`nerg <integrator-nerg>`. As a plain volume it returns the density in 1/scene unit through ``eval_1``. The density
is 0 outside ``bbox()``, and in the empty cells of the checkpoint's occupancy grid: training does not sample these, and
marching skips them. With ``max_density`` it can be the ``sigma_t`` of a ``heterogeneous`` medium. (A plain volume has
no colour, since it is not given the direction.)

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
from nerg_mi.fields.radiance import RadianceNetwork
from nerg_mi.formats.fields import load_radiance
from nerg_mi.maths.geometry import Similarity
from nerg_mi.properties import load_network, make_volume_class, read_boolean, read_number, read_transform
from nerg_mi.ranges import POSITIVE_VALUES, Range
from nerg_mi.registration import register
from nerg_mi.transport.field_medium import FieldMedium


class NerfVolume(make_volume_class()):
    __doc__ = __doc__
    plugin = "nerf"

    def __init__(self, props, network=None):
        # ``network``: a field in memory instead of a file; see ``from_network``.
        similarity = Similarity(read_transform(props, "to_world"))
        field, metadata, filename = load_network(props, network, load_radiance, namespace(mi.Float))
        # Mitsuba's own media use the box of the base class, which it derives from the unit cube, and not bbox().
        lower, upper = similarity.bounds(field.box.lower, field.box.upper)
        props["to_world"] = mi.ScalarTransform4f().translate(lower.tolist()).scale((upper - lower).tolist())
        super().__init__(props)
        self.filename, self.field, self.metadata, self._similarity = filename, field, metadata, similarity
        self.max_density = read_number(props, "max_density", 0, Range(0, POSITIVE_VALUES.high))
        if read_boolean(props, "constant_weights", False):
            set_constant_weights(field)

    @staticmethod
    def check(network: RadianceNetwork) -> None:
        if not isinstance(network, RadianceNetwork):
            raise NergError(
                f"expected a radiance field in memory, got {type(network).__name__}; load it from its file first"
            )

    def medium(self) -> FieldMedium:
        """The field as a medium."""
        return FieldMedium(self.field, self._similarity)

    def eval_1(self, it: Any, active: Any = True):
        sigma = self.medium().density_in_occupied_cells(self._similarity.point_to_local(it.p), active)
        return dr.minimum(sigma, self.max_density) if self.max_density else sigma

    def max(self):
        if not self.max_density:
            raise NergError(
                f'a medium needs an upper bound of the density of "{self.filename}"; set "max_density" of the volume'
            )
        return self.max_density

    def parameters_changed(self, keys=()):
        # Mitsuba passes the last part of each name only, by which the networks cannot be told apart.
        if not set(keys) or set(keys) - {"log_density", "color_basis"}:
            super().parameters_changed(keys)
        elif "color_basis" in keys:
            self.field.voxels.colors.net.pack()

    def resolution(self):
        cells = int(self.field.config.grid.finest)
        return mi.ScalarVector3i(cells, cells, cells)

    def describe(self):
        c, (lower, upper) = self.field.config, self.bounds()
        return {
            "filename": self.filename,
            "grid": c.grid.describe(),
            "networks": f"{c.density_sizes}, {c.color_sizes}{' (once per ray)' if c.deferred else ''}",
            "bbox": f"{lower.round(4).tolist()} to {upper.round(4).tolist()}",
            "color_space": self.field.color_space,
            **({} if self.field.voxels is None else {"voxels": f"{self.field.voxels.resolution} along an edge"}),
        }


register("volume", "nerf", NerfVolume)
