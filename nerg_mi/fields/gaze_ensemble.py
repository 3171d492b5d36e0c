"""Several gaze fields for one: their mean is the gaze, their spread says how far the data decides it.

Members are trained alike on resamples of the people (bagging, Breiman 1996; deep ensembles, Lakshminarayanan et al.
2017).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any, ClassVar

import drjit as dr

from nerg_mi.maths.geometry import AnyBox
from nerg_mi.maths.types import Float

from .gaze_base import SIZE_LIMITS, Arrays, Basis, GazeDensity, RaySupport, build, register
from .mlp import MLP


@register
class GazeEnsemble:
    """``members``: two or more fields of one kind, variant and box. Raises ``ValueError`` where they differ in these.

    ``config`` and ``box`` are those of the first member; ``support``: of the rays that all members' were drawn from.
    """

    DRJIT_STRUCT: ClassVar[dict] = {"members": None}
    kind: ClassVar[str] = "ensemble"
    limits: ClassVar[Mapping[str, int]] = SIZE_LIMITS
    fixed: ClassVar[tuple[str, ...]] = ()

    def __init__(self, members: Sequence[GazeDensity], support: RaySupport | None = None):
        self.members, self.support = list(members), support
        self.basis: Basis | None = None
        if len(self.members) < 2:
            raise ValueError(f"an ensemble of gaze fields needs at least two members, got {len(self.members)}")
        if any(len(m.members) > 1 for m in self.members):
            raise ValueError("a member of an ensemble of gaze fields is an ensemble itself; give its members instead")
        if any(_common(m) != _common(self.members[0]) for m in self.members):
            raise ValueError(
                "the members of an ensemble of gaze fields differ in kind, variant, output or box; train them alike"
            )
        self.config, self.box = self.members[0].config, self.members[0].box

    @classmethod
    def from_arrays(cls, about: dict, box: AnyBox, arrays: Arrays) -> GazeEnsemble:
        """The ensemble of a checkpoint."""
        members = [arrays.member(i, member) for i, member in enumerate(about["members"])]
        # Before any is built: a file may hold them one inside of another, without end.
        if any("members" in member for member, _ in members):
            raise ValueError("a member of its ensemble is an ensemble itself, which this version does not read")
        return cls([density for member, own in members for density in build(member, box, own).members])

    def architecture(self) -> dict:
        """What ``from_arrays`` needs besides the arrays."""
        return {"kind": self.kind, "members": [m.architecture() for m in self.members]}

    @property
    def networks(self) -> int:
        """Networks that one evaluation of gaze evaluates: all members'."""
        return sum(m.networks for m in self.members)

    @property
    def mlps(self) -> list[MLP]:
        """All members' networks."""
        return [net for member in self.members for net in member.mlps]

    @property
    def ns(self) -> ModuleType:
        """Array types of the members' backend; see ``fields.mlp.namespace``."""
        return self.members[0].ns

    def parameters(self) -> dict:
        """All members' arrays: ``0.grid.table`` and so on."""
        return {f"{i}.{name}": value for i, m in enumerate(self.members) for name, value in m.parameters().items()}

    def set_parameters(self, values: dict) -> None:
        """Replace arrays by name (any subset of ``parameters()``)."""
        for i, member in enumerate(self.members):
            member.set_parameters({k.removeprefix(f"{i}."): v for k, v in values.items() if k.startswith(f"{i}.")})

    def pack(self) -> None:
        """Refresh what the kernels read; call after any change of the weights."""
        for member in self.members:
            member.pack()


def mean(found: list[tuple]) -> tuple:
    """Means of the ``(gaze, emit, capture)`` of one or more members; that of gaze is not the product of the others."""
    if len(found) == 1:
        return found[0]
    return tuple(sum(parts[1:], parts[0]) / len(found) for parts in zip(*found))


def spread(found: list[tuple]) -> Float:
    """Standard deviation of gaze over the ``(gaze, emit, capture)`` of two or more members (1/sr, of N - 1 degrees of
    freedom)."""
    gaze = mean(found)[0]
    variance: Any = sum(dr.square(g - gaze) for g, _, _ in found) / (len(found) - 1)
    # Where members agree, the root's derivative would not be finite.
    apart = variance > 1e-30
    return dr.select(apart, dr.sqrt(dr.select(apart, variance, 1)), 0)


def _common(field: GazeDensity) -> tuple:
    return field.config.conventions(), tuple(field.box.lower), tuple(field.box.upper)
