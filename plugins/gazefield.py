r"""
.. _volume-gazefield:

Trained gaze field (:monosp:`gazefield`)
----------------------------------------

.. pluginparameters::

 * - filename
   - |string|
   - Checkpoint (safetensors) written by ``nerg train gaze`` or ``nerg_mi.formats.fields.save_gaze``.
     Relative names are looked up beside the scene file.

 * - to_world
   - |transform|
   - A rotation, a uniform scale and a translation that place the field in the scene; it should be that of the radiance
     field. Densities over directions do not change with scale. (Default: none)

 * - constant_weights
   - |bool|
   - Write the weights of the networks into the kernels, for many large frames of one field: the same pictures to the
     bit in less time, after some seconds of compilation for each size of picture (docs/explanation/performance.md, "Weights as
     constants"). Only on processors, and where nothing is differentiated; weights that change often are not for it.
     (Default: false)

 * - grid.table, position_net.0, ..., direction_net.0, ..., emit_head.0, capture_head.0
   - |tensor|
   - Features of the grid and the weight matrices of the trunk and of the two heads.
   - |exposed|, |differentiable|

 * - 0.grid.table, 1.grid.table, ...
   - |tensor|
   - Of an ensemble: the arrays of each member, by its number.
   - |exposed|, |differentiable|

 * - grid.table, emit_net.0, ..., capture_net.0, ..., escaped, prior
   - |tensor|
   - Of a log density: features of the grid, the weight matrices of its two networks, the logit where no surface is met,
     and the table of the log of the density that does not depend on the position.
   - |exposed|, |differentiable|

How much surfaces attract an observer: equation 1 of the paper,
:math:`G(p_{od}, p_o) = F_e(p_{od}, -r_o) \cdot \mathrm{sigmoid}(F_c(p_o, r_o))`, a density in 1/sr over the directions
around the observer. It is the ``gaze`` of the integrator :ref:`nerg <integrator-nerg>`; having two positions for an
argument, it cannot be evaluated as a plain volume. A field that was trained on a radiance field's features
(``nerg train gaze --semantic``) needs that radiance field beside it, as the integrator's ``field``.

Of an ensemble (``nerg train gaze --ensemble``) gaze is the mean of the members, each normalised by itself where it is
normalised, and the integrator knows their standard deviation (its AOV ``gaze_std``). The checkpoint also says how many
rays there were around a position (``support``).

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

import mitsuba as mi

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import AnyGazeField, kinds
from nerg_mi.fields.mlp import namespace, set_constant_weights
from nerg_mi.formats.fields import load_gaze
from nerg_mi.maths.geometry import Similarity
from nerg_mi.properties import read_boolean, load_network, read_transform, make_volume_class
from nerg_mi.registration import register
from nerg_mi.transport.observer_gaze import GazeFieldInstance


class GazeFieldVolume(make_volume_class()):
    __doc__ = __doc__
    plugin = "gazefield"

    def __init__(self, props, network=None):
        # ``network``: a field in memory in place of a file; see ``of``.
        super().__init__(props)
        self.field, self.metadata, self.filename = load_network(props, network, load_gaze, namespace(mi.Float))
        self._similarity = Similarity(read_transform(props, "to_world"))
        if read_boolean(props, "constant_weights", False):
            set_constant_weights(self.field)

    @staticmethod
    def check(network: AnyGazeField) -> None:
        if getattr(network, "kind", None) not in kinds():
            raise NergError(f"a gaze field in memory is needed, got {type(network).__name__}; load one from its file")

    def placed_gaze(self) -> GazeFieldInstance:
        """The gaze field as the integrator sees it."""
        return GazeFieldInstance(self.field, self._similarity)

    def bounds(self):
        return self._similarity.bounds(self.field.box.lower, self.field.box.upper)

    def describe(self):
        c = self.field.config
        about = {"filename": self.filename, "members": len(self.field.members), "variant": c.variant}
        return {**about, "normalized": c.normalized, **{k: v for k, v in c.to_dict().items() if k not in about}}


register("volume", "gazefield", GazeFieldVolume)
