r"""
.. _volume-gazefield:

Gaze field (:monosp:`gazefield`)
--------------------------------

.. pluginparameters::

 * - filename
   - |string|
   - Checkpoint (safetensors) written by ``nerg train gaze`` or ``nerg_mi.formats.fields.save_gaze``. Relative names are
     resolved in the folder of the scene file.

 * - to_world
   - |transform|
   - Rotation, uniform scale and translation of the field in the scene; usually that of the radiance field. Densities
     over directions are invariant to scale. (Default: none)

 * - constant_weights
   - |bool|
   - Write the weights of the networks into the kernels as literals: bit-identical images in less time, after some
     seconds of compilation for each image size (docs/explanation/performance.md, "Weights as constants"). For many
     large frames of one field; only on CPUs, without derivatives, and for weights that rarely change. (Default: false)

 * - reaimed_hits
   - |bool|
   - Mix in the re-aimed hits of the checkpoint, if it has any. Without them gaze is the mixture of networks and prior;
     functions that ``dr.freeze`` records need this. (Default: true)

 * - grid.table, position_net.0, ..., direction_net.0, ..., emit_head.0, capture_head.0
   - |tensor|
   - Features of the grid and weight matrices of the trunk and of both heads.
   - |exposed|, |differentiable|

 * - 0.grid.table, 1.grid.table, ...
   - |tensor|
   - For an ensemble: the arrays of each member, by its number.
   - |exposed|, |differentiable|

 * - grid.table, emit_net.0, ..., capture_net.0, ..., escaped, prior
   - |tensor|
   - For a log density: features of the grid, weight matrices of both networks, the logit of directions without a
     surface, and the table of the log of the position-independent prior.
   - |exposed|, |differentiable|

How much surfaces attract an observer: equation 1 of the paper, :math:`G(p_{od}, p_o) = F_e(p_{od}, -r_o) \cdot
\mathrm{sigmoid}(F_c(p_o, r_o))`, a density in 1/sr over the directions around the observer. A log density, the default
of trainings, divides this product by its integral over all directions, and mixes in a prior. A field is the ``gaze`` of
the integrator :ref:`nerg <integrator-nerg>`; since it depends on two positions, it cannot be evaluated as a plain
volume. A field that was trained on the features of a radiance field (option ``semantic`` of a recipe) needs that
radiance field as the integrator's ``field``.

For an ensemble (``nerg train gaze --ensemble``) gaze is the mean of the members, each normalised separately if it is
normalised; the AOV ``gaze_std`` of the integrator shows their standard deviation. The checkpoint also stores the number
of training rays near a position (AOV ``support``), and may store re-aimed hits (``nerg train gaze --reaimed-hits``):
hit points of training rays, whose kernel density around the observer is mixed into ``gaze``. It is differentiable in
the observer's position and in directions to first order.

.. tabs::
    .. code-tab:: xml
        :name: gazefield-volume

        <volume type="gazefield" name="gaze">
            <string name="filename" value="shoppers.safetensors"/>
        </volume>

    .. code-tab:: python

        'gaze': {
            'type': 'gazefield',
            'filename': 'shoppers.safetensors'
        }
"""

from __future__ import annotations

from copy import copy

import mitsuba as mi

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import GazeNetwork, kinds
from nerg_mi.fields.mlp import namespace, set_constant_weights
from nerg_mi.formats.fields import load_gaze
from nerg_mi.maths.geometry import Similarity
from nerg_mi.properties import load_network, make_volume_class, read_boolean, read_transform
from nerg_mi.registration import register
from nerg_mi.transport.observer_gaze import GazeFieldInstance


class GazeFieldVolume(make_volume_class()):
    __doc__ = __doc__
    plugin = "gazefield"

    def __init__(self, props, network=None):
        # ``network``: a field in memory instead of a file; see ``from_network``.
        super().__init__(props)
        self.field, self.metadata, self.filename = load_network(props, network, load_gaze, namespace(mi.Float))
        if not read_boolean(props, "reaimed_hits", True) and self.field.hits is not None:
            # A copy, because the field in memory may be used elsewhere.
            self.field = copy(self.field)
            self.field.hits = None
        self._similarity = Similarity(read_transform(props, "to_world"))
        if read_boolean(props, "constant_weights", False):
            set_constant_weights(self.field)

    @staticmethod
    def check(network: GazeNetwork) -> None:
        if getattr(network, "kind", None) not in kinds():
            raise NergError(
                f"expected a gaze field in memory, got {type(network).__name__}; load it from its file first"
            )

    def placed_gaze(self) -> GazeFieldInstance:
        """The gaze field for the integrator."""
        return GazeFieldInstance(self.field, self._similarity)

    def bounds(self):
        return self._similarity.bounds(self.field.box.lower, self.field.box.upper)

    def describe(self):
        c = self.field.config
        properties = {"filename": self.filename, "members": len(self.field.members), "variant": c.variant}
        return {
            **properties,
            "normalized": c.normalized,
            **{k: v for k, v in c.to_dict().items() if k not in properties},
        }


register("volume", "gazefield", GazeFieldVolume)
