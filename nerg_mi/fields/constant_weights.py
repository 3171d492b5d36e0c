"""Which fields are evaluated with their weights as constants of the kernels (``unrolled``)."""

from __future__ import annotations

from .gaze_base import AnyGazeField
from .radiance import RadianceField


def set_constant_weights(field: RadianceField | AnyGazeField, constant: bool = True) -> None:
    """Whether the networks of ``field`` (of an ensemble all members') are evaluated with their weights as constants of
    the kernel.

    It holds for processors, where nothing is differentiated and no function is recorded by ``dr.freeze``; elsewhere,
    and of networks with normalised layers, evaluations are as before. New weights take a new compilation.
    """
    for net in field.mlps:
        net.constant = constant
