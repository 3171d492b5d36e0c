"""Which fields are evaluated with their weights as constants of the kernels (``unrolled``)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from .mlp import MLP


def set_constant_weights(field: Any, constant: bool = True) -> None:
    """Whether the networks of ``field`` (a radiance or a gaze field; of an ensemble all members') are evaluated with
    their weights as constants of the kernel.

    It holds for processors, where nothing is differentiated and no function is recorded by ``dr.freeze``; elsewhere,
    and of networks with normalised layers, evaluations are as before. New weights take a new compilation.
    """
    for net in _networks(field):
        net.constant = constant


def _networks(part: Any) -> Iterator[MLP]:
    members = getattr(part, "members", [part])
    if members != [part]:
        for member in members:
            yield from _networks(member)
        return
    for value in vars(part).values():
        if isinstance(value, MLP):
            yield value
    background = getattr(part, "background", None)
    if background is not None:
        yield background.net
