"""Several gaze fields for one: their mean is the gaze, their spread says how far the data decides it.

Members are trained alike on resamples of the people (bagging, Breiman 1996; deep ensembles, Lakshminarayanan et al.
2017).
"""

from __future__ import annotations

from types import ModuleType

from .log_density import LogGazeField
from .product import GazeField
from .support import RaySupport


class GazeEnsemble:
    """``members``: two or more fields of one kind, variant and box. Raises ``ValueError`` where they differ in these.

    ``config`` and ``grid`` are those of the first member; ``support``: of the rays that all members' were drawn from.
    """

    DRJIT_STRUCT = {"members": None}

    def __init__(self, members: list[GazeField | LogGazeField], support: RaySupport | None = None):
        self.members, self.support = list(members), support
        if len(self.members) < 2:
            raise ValueError(f"an ensemble of gaze fields needs at least two members, got {len(self.members)}")
        if any(_kind(m) != _kind(self.members[0]) for m in self.members):
            raise ValueError(
                "the members of an ensemble of gaze fields differ in kind, variant, output or box; train them alike"
            )
        self.config, self.box, self.grid = self.members[0].config, self.members[0].box, self.members[0].grid

    @property
    def ns(self) -> ModuleType:
        """Array types of the members' backend; see ``field.backend.namespace``."""
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


def _kind(field) -> tuple:
    c = field.config
    more = [
        getattr(c, name, None)
        for name in ("variant", "activation", "normalized", "semantic", "geometry", "escaped", "reach")
    ]
    return type(field), tuple(field.box.lower), tuple(field.box.upper), *more
