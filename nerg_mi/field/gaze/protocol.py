"""What every gaze field answers, whatever it is made of.

A gaze field is a density over the directions around an observer (1/sr): a product of two factors (``product``), a
normalised log density (``log_density``), or any other class that fulfils ``GazeDensity`` and is registered
(``registry``); or the mean of several of these (``ensemble``). Nothing outside of this package asks which of them it
has.

Positions and directions are Dr.Jit 3-arrays of the field's backend, in the field's own frame and units; directions are
unit vectors, and ``r_o`` points from the observer to the surface. Densities do not change with scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType
from typing import ClassVar, Protocol

import numpy as np

from nerg_mi.field.encoding.protocol import Encoding, EncodingConfig
from nerg_mi.field.mlp import MLP
from nerg_mi.maths.geometry import AnyBox
from nerg_mi.maths.types import Bool, Float, Point3f, Vector3f

from .basis import Basis
from .support import RaySupport


class GazeFieldConfig(Protocol):
    """Sizes and conventions of a gaze field: a frozen dataclass that a checkpoint keeps as JSON."""

    kind: ClassVar[str]
    """The name under which a checkpoint knows the field's class."""

    @property
    def variant(self) -> str:
        """``emit``, ``capture`` or ``emit_capture``: which of the two factors there are."""
        ...

    @property
    def activation(self) -> str:
        """What the network's output goes through to become a density; for people, not for code."""
        ...

    @property
    def normalized(self) -> bool:
        """Whether ``evaluate`` divides by the integral over the observer's sphere, which it then must be given."""
        ...

    @property
    def semantic(self) -> str:
        """Which features of a radiance field emit takes: ``accumulated``, ``snapshot`` or none ("")."""
        ...

    @property
    def features(self) -> int:
        """How many such features of a point; 0 without."""
        ...

    @property
    def prior(self) -> int:
        """Rows of the table of the density that does not depend on the position; 0 for a field that has none."""
        ...

    @property
    def needs_surfaces(self) -> bool:
        """Whether it matters where the observer's rays meet a surface."""
        ...

    @property
    def fills_escaped(self) -> bool:
        """Whether a direction in which no surface is met takes the depth of the nearest ones that do; otherwise it ends
        on the field's box."""
        ...

    def conventions(self) -> tuple:
        """What fields must have in common for their densities to be averaged."""
        ...

    def to_dict(self) -> dict:
        """As JSON; with ``kind`` unless that is ``product``, which older checkpoints do not name."""
        ...


LARGEST = 1e6
"""No stored weight is larger; products of a network's layers then stay in single precision."""


class Arrays(Protocol):
    """The arrays of a checkpoint, as a field's ``from_arrays`` asks for them. Every method raises ``ValueError`` for an
    array that is not finite or does not have the shape, ``KeyError`` for one that is missing."""

    ns: ModuleType

    def array(self, name: str, *shape: int | None, largest: float = LARGEST) -> np.ndarray:
        """The float32 array ``name`` of that ``shape`` (None: of any length), with no value beyond ``largest``."""
        ...

    def grid(self, config: EncodingConfig, name: str = "grid") -> Encoding:
        """The encoding of ``config``."""
        ...

    def net(self, name: str, sizes: list[int], normalized: bool = False) -> MLP:
        """The network whose layers have these ``sizes``; ``normalized``: with the gains and shifts of LayerNorm."""
        ...

    def member(self, index: int, about: dict) -> tuple[dict, Arrays]:
        """The checked architecture and the arrays of the member ``index`` of an ensemble."""
        ...


class AnyGazeField(Protocol):
    """A gaze field on one backend: one density or the mean of several, which are its ``members``."""

    kind: ClassVar[str]
    support: RaySupport | None
    """How many rays it learnt from around a position, where that is known."""
    basis: Basis | None
    """How many rays and people it learnt from in all, where that is known."""

    @property
    def config(self) -> GazeFieldConfig:
        """Sizes and conventions."""
        ...

    @property
    def box(self) -> AnyBox:
        """Where the field lives; positions outside of it are the encoding's to deal with."""
        ...

    @property
    def ns(self) -> ModuleType:
        """Array types of the field's backend (``field.backend.namespace``)."""
        ...

    @property
    def members(self) -> Sequence[GazeDensity]:
        """The densities whose mean it is; itself alone where it is one."""
        ...

    @property
    def networks(self) -> int:
        """Networks that one evaluation of gaze evaluates."""
        ...

    @property
    def mlps(self) -> list[MLP]:
        """All of its networks, those of all members."""
        ...

    def architecture(self) -> dict:
        """What ``from_arrays`` needs besides the arrays (JSON)."""
        ...

    @classmethod
    def from_arrays(cls, about: dict, box: AnyBox, arrays: Arrays) -> AnyGazeField:
        """The field of ``architecture() == about`` with the ``arrays`` of a checkpoint."""
        ...

    def parameters(self) -> dict:
        """Arrays that gaze depends on, by the names that checkpoints and ``mi.traverse`` give them."""
        ...

    def set_parameters(self, values: dict) -> None:
        """Replace arrays by name (any subset of ``parameters()``)."""
        ...

    def pack(self) -> None:
        """Refresh what the kernels read; call after any change of the weights."""
        ...


class GazeDensity(AnyGazeField, Protocol):
    """A gaze field that is one density."""

    def unnormalized(
        self,
        p_od: Point3f,
        p_o: Point3f,
        r_o: Vector3f,
        active: Bool = True,
        semantic: list[Float] | None = None,
        escaped: Bool = False,
    ) -> tuple[Float, Float]:
        """``(emit, capture)``, whose product a normalised field divides by its integral. A variant that lacks a factor
        has 1 in its place and does not evaluate it.

        ``semantic``: ``config.features`` Floats where the configuration asks for them, else None; ``escaped``: mask of
        directions in which no surface is met. Differentiable in the parameters, positions and directions.
        """
        ...

    def evaluate(
        self,
        p_od: Point3f,
        p_o: Point3f,
        r_o: Vector3f,
        active: Bool = True,
        semantic: list[Float] | None = None,
        integral: Float | None = None,
        escaped: Bool = False,
    ) -> tuple[Float, Float, Float]:
        """``(gaze, emit, capture)`` in 1/sr of the observer at ``p_o`` attending ``p_od`` along ``r_o``.

        ``integral``: of a normalised field over the sphere at ``p_o``, by which ``emit`` is divided (``ValueError``
        without it); the others as for ``unnormalized``.
        """
        ...
