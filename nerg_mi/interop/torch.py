"""Fields as ``torch.nn.Module``: forward and backward through Dr.Jit, weights as torch parameters.

::

    module = RadianceModule(load_radiance("field.safetensors", namespace("llvm"))[0])
    optimizer = torch.optim.Adam(module.parameters(), 1e-2)
    sigma, color = module(p, d)
    ...
    save_radiance(module.field(), "trained.safetensors", {})

First derivatives only, with respect to the weights and to positions and directions. Tensors are float32, on the CPU for
a field of the LLVM backend and on the GPU for one of the CUDA backend.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, cast

import drjit as dr
import numpy as np

try:
    import torch
except ImportError:
    raise ImportError(
        'fields as torch modules need torch, which is not installed: pip install "nerg-mi[torch]"'
    ) from None

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import AnyGazeField, GazeEnsemble
from nerg_mi.fields.mlp import is_cuda
from nerg_mi.fields.radiance import RadianceField


class _FieldModule(torch.nn.Module):
    """The parameters of a field, by the field's names with "__" for "."; ``fixed`` ones have no gradients."""

    def __init__(self, field, fixed: Sequence[str] = ()):
        super().__init__()
        self._field, self._ns = field, field.ns
        self.device_type = "cuda" if is_cuda(self._ns) else "cpu"
        for name, value in field.parameters().items():
            tensor = torch.tensor(value.numpy(), device=self.device_type)
            self.register_parameter(
                name.replace(".", "__"), torch.nn.Parameter(tensor, requires_grad=name not in fixed)
            )

    def _values(self) -> dict:
        return {name: self.get_parameter(name.replace(".", "__")) for name in self._field.parameters()}

    def field(self):
        """A field of its own with the weights as they are now."""
        out = _with(self._field, {})
        out.set_parameters({k: self._array(k, v.detach().cpu().numpy()) for k, v in self._values().items()})
        return out

    def _array(self, name: str, value: np.ndarray):
        kind = type(self._field.parameters()[name])
        return kind(value) if dr.is_tensor_v(kind) else kind(value.ravel())

    def _rows(self, **tensors) -> list:
        """Inputs (N, 3), checked."""
        count = {len(t) for t in tensors.values() if t.ndim == 2 and t.shape[1] == 3}
        for name, t in tensors.items():
            rows = t.ndim == 2 and t.shape[1] == 3 and len(count) == 1
            if not rows or t.dtype != torch.float32 or t.device.type != self.device_type:
                raise ValueError(
                    f"{name} must be a float32 tensor (N, 3) on {self.device_type}, of one N with the others, got "
                    f"{t.dtype} {tuple(t.shape)} on {t.device.type}"
                )
        return [t.contiguous() for t in tensors.values()]

    def _evaluate(self, function, *inputs):
        """``function(field, *arrays)``, a list of rows, at torch ``inputs``, (N, 3) as Array3f and others as lists of
        their columns: a torch tensor (rows, N)."""
        ns, field = self._ns, self._field
        tensors = {k for k, v in field.parameters().items() if dr.is_tensor_v(v)}

        @dr.wrap(source="torch", target="drjit")
        def evaluate(values, *points):
            arrays = {k: ns.TensorXf(v) if k in tensors else ns.Float(v.array) for k, v in values.items()}
            here = _with(field, arrays)
            columns = [_columns(ns, p) for p in points]
            out = function(here, *columns)
            return ns.TensorXf(
                dr.ravel(ns.ArrayXf([ns.Float(c) for c in out]), order="C"), (len(out), dr.width(columns[0][0]))
            )

        # dr.wrap knows tensors, and passes by their subclass for parameters.
        return evaluate({k: v.view_as(v) for k, v in self._values().items()}, *inputs)


class RadianceModule(_FieldModule):
    """Density and colour of a radiance field. Its occupancy grid is not applied: training in torch may fill empty
    cells."""

    def __init__(self, field: RadianceField):
        super().__init__(field)

    def forward(self, p: torch.Tensor, d: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Density (N,) in 1/unit and colour (N, 3) in the field's colour space at ``p`` (N, 3) seen along unit ``d``
        (N, 3). Of a deferred field this is the colour of matter that is opaque there; a ray's is that of its mean
        features (`density_features`, `color`)."""

        def both(field, p, d):
            sigma, features = field.density_features(p)
            return [sigma, *field.color(features, d)]

        out = self._evaluate(both, *self._rows(p=p, d=d))
        return out[0], out[1:].T

    def density(self, p: torch.Tensor) -> torch.Tensor:
        """Density (N,) in 1/unit at ``p`` (N, 3); 0 outside of the box."""
        return self._evaluate(lambda field, p: [field.density(p)], *self._rows(p=p))[0]

    def density_features(self, p: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Density (N,) in 1/unit at ``p`` (N, 3), and the features (N, G) of which `color` makes colours."""

        def both(field, p):
            sigma, features = field.density_features(p)
            return [sigma, *features]

        out = self._evaluate(both, *self._rows(p=p))
        return out[0], out[1:].T

    def color(self, features: torch.Tensor, d: torch.Tensor) -> torch.Tensor:
        """Colour (N, 3) in the field's colour space of ``features`` (N, G) seen along unit ``d`` (N, 3); of a deferred
        field also that of rays with these mean features, Σ w g / Σ w, times whose opacity, Σ w, it is to be taken."""
        count = self._field.config.geometry
        if features.shape[1:] != (count,):
            raise ValueError(f"features have shape {tuple(features.shape)}, and must have shape (N, {count})")
        (d,) = self._rows(d=d)
        return self._evaluate(lambda field, f, d: list(field.color(list(f), d)), features.contiguous(), d).T

    def background(self, o: torch.Tensor, d: torch.Tensor) -> torch.Tensor:
        """Colour (N, 3) behind the field of rays from ``o`` (N, 3) along unit ``d`` (N, 3)."""
        if self._field.background is None:
            raise ValueError("this field was trained without a background network")
        return self._evaluate(lambda field, o, d: list(field.background(o, d)), *self._rows(o=o, d=d)).T


class GazeModule(_FieldModule):
    """The gaze density of a gaze field, be it normalised over the observer's sphere or not.

    A normalised field's integral is found once an observer, over directions of equal area::

        around = ObserverTracer(field, Similarity(), place, eye, settings).trace()  # directions, their depths, what escapes

        Z = module.integral(p_od, p_o, r_o, escaped)  # everywhere around the observer
        gaze = module(p_od, p_o, r_o, Z)  # anywhere

    Raises `NergError` for an ensemble, which is a `GazeEnsembleModule`.
    """

    def __init__(self, field: AnyGazeField):
        if len(field.members) > 1:
            raise NergError(
                f"an ensemble of {len(field.members)} gaze fields is no GazeModule; make a GazeEnsembleModule of it"
            )
        super().__init__(field, field.fixed)

    def forward(
        self,
        p_od: torch.Tensor,
        p_o: torch.Tensor,
        r_o: torch.Tensor,
        integral: torch.Tensor | float | None = None,
        misses: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Gaze (N,) in 1/sr of observers ``p_o`` (N, 3) who see ``p_od`` (N, 3) along unit ``r_o`` (N, 3).

        ``integral``: of a normalised field over the sphere around each observer, (N,) or one number for all (see
        ``integral``); ``escaped`` (N,) bool: where no surface is met (default: nowhere). Raises ``ValueError`` for a
        normalised field without its integral, and for tensors that do not fit.
        """
        if self._field.config.normalized and integral is None:
            raise ValueError(
                'this gaze field is normalised over the observer\'s sphere: give its "integral" there, which the '
                "method integral finds"
            )
        extra = self._extra(len(p_od), 1.0 if integral is None else integral, misses)
        evaluate = lambda field, p, o, r, e: [field.evaluate(p, o, r, integral=e.x, escaped=e.y > 0.5)[0]]
        return self._evaluate(evaluate, *self._rows(p_od=p_od, p_o=p_o, r_o=r_o), extra)[0]

    def evaluate_unnormalized(
        self, p_od: torch.Tensor, p_o: torch.Tensor, r_o: torch.Tensor, misses: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Emit times capture (N,) before any division: what the integral is one of. Arguments as for ``forward``."""

        def product(field, p, o, r, e):
            emit, capture = field.unnormalized(p, o, r, escaped=e.y > 0.5)
            return [emit * capture + dr.zeros(type(e.x), dr.width(e))]

        return self._evaluate(product, *self._rows(p_od=p_od, p_o=p_o, r_o=r_o), self._extra(len(p_od), 1.0, misses))[
            0
        ]

    def integral(
        self, p_od: torch.Tensor, p_o: torch.Tensor, r_o: torch.Tensor, misses: torch.Tensor | None = None
    ) -> torch.Tensor:
        """The integral over the sphere (one number) of one observer, who is ``p_o`` in every row, from N directions
        ``r_o`` of equal area that lead to ``p_od``. Of the integrator's many directions it is the integrator's
        (``transport.observer_gaze``)."""
        return 4 * torch.pi * self.evaluate_unnormalized(p_od, p_o, r_o, misses).mean()

    def _extra(self, count: int, integral, escaped) -> torch.Tensor:
        """Integrals and what escapes as rows (N, 3)."""
        number = torch.as_tensor(integral, dtype=torch.float32, device=self.device_type)
        gone = (
            torch.zeros(count, dtype=torch.float32, device=self.device_type)
            if escaped is None
            else escaped.to(torch.float32)
        )
        for name, t in (("integral", number), ("escaped", gone)):
            if t.numel() != 1 and tuple(t.shape) != (count,):
                raise ValueError(
                    f"{name} must be one number or a tensor of {count}, one for each row, got {tuple(t.shape)}"
                )
        columns = [number.reshape(-1).expand(count), gone.reshape(-1).expand(count)]
        return torch.stack([*columns, torch.zeros_like(columns[0])], 1).contiguous()


class GazeEnsembleModule(torch.nn.Module):
    """The mean of the gaze densities of an ensemble's members, of which ``members`` are modules (`GazeModule`).

    Each member of a normalised ensemble has an integral of its own::

        Z = module.integral(p_od, p_o, r_o, escaped)  # everywhere around the observer: (members,)
        gaze = module(p_od, p_o, r_o, Z)  # anywhere
        spread = module.each(p_od, p_o, r_o, Z).std(0)
    """

    def __init__(self, field: GazeEnsemble):
        super().__init__()
        self._field = field
        self.members = torch.nn.ModuleList(GazeModule(member) for member in field.members)

    def field(self) -> GazeEnsemble:
        """An ensemble of its own with the weights as they are now."""
        ensemble = GazeEnsemble([member.field() for member in self._densities()], self._field.support)
        ensemble.basis = self._field.basis
        return ensemble

    def _densities(self) -> list[GazeModule]:
        return cast("list[GazeModule]", list(self.members))

    def forward_members(
        self,
        p_od: torch.Tensor,
        p_o: torch.Tensor,
        r_o: torch.Tensor,
        integral: torch.Tensor | None = None,
        misses: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Gaze (members, N) of every member. ``integral``: of a normalised ensemble, (members,) or (members, N); the
        other arguments, and what is raised, as for `GazeModule`."""
        if integral is not None and len(integral) != len(self.members):
            raise ValueError(f"give the integral of each of the {len(self.members)} members, got {len(integral)}")
        integrals = [None] * len(self.members) if integral is None else integral
        return torch.stack([member(p_od, p_o, r_o, z, misses) for member, z in zip(self._densities(), integrals)])

    def forward(
        self,
        p_od: torch.Tensor,
        p_o: torch.Tensor,
        r_o: torch.Tensor,
        integral: torch.Tensor | None = None,
        misses: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Gaze (N,) in 1/sr, the mean of ``each``."""
        return self.forward_members(p_od, p_o, r_o, integral, misses).mean(0)

    def integral(
        self, p_od: torch.Tensor, p_o: torch.Tensor, r_o: torch.Tensor, misses: torch.Tensor | None = None
    ) -> torch.Tensor:
        """The integrals of the members (members,) over the sphere of one observer; see ``GazeModule.integral``."""
        return torch.stack([member.integral(p_od, p_o, r_o, misses) for member in self._densities()])


def _columns(ns, p):
    rows, count = p.shape
    index = count * dr.arange(ns.UInt32, rows)
    # No two points share a number, so that derivatives need no atomic additions.
    columns = [dr.gather(ns.Float, p.array, index + k, mode=dr.ReduceMode.Permute) for k in range(count)]
    return ns.Array3f(*columns) if count == 3 else columns


def _with(field, values: dict):
    """A copy of ``field`` whose parameters of these names are ``values``, attached to them."""
    out = _copied(field)
    for owner in {name.partition(".")[0] for name in field.parameters()}:
        if owner.endswith("grid"):
            getattr(out, owner).mode = dr.ReduceMode.Expand
    out.set_parameters(values)
    return out


def _copied(part: Any) -> Any:
    """A copy of a field's part down to its arrays, which both share, and what ``pack`` makes of them."""
    if isinstance(part, list):
        return [_copied(p) for p in part]
    if isinstance(part, dict):
        return {k: _copied(p) for k, p in part.items()}
    if not hasattr(part, "DRJIT_STRUCT"):
        return part
    out = copy.copy(part)
    for name in part.DRJIT_STRUCT:
        if not name.startswith("_"):
            setattr(out, name, _copied(getattr(part, name)))
    return out
