"""Fields as ``torch.nn.Module``: evaluation and gradients through Dr.Jit, with weights as torch parameters.

::

    module = RadianceModule(load_radiance("field.safetensors", namespace("llvm"))[0])
    optimizer = torch.optim.Adam(module.parameters(), 1e-2)
    sigma, color = module(p, d)
    ...
    save_radiance(module.field(), "trained.safetensors", {})

Only first derivatives are supported, with respect to the weights and to positions and directions. Tensors are float32,
on the CPU for a field of the LLVM backend and on the GPU for a field of the CUDA backend.
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
from nerg_mi.maths.arrays import copy_aligned, to_vector

from .gaze_base import GazeEnsemble, GazeNetwork
from .mlp import is_cuda
from .radiance import RadianceNetwork


class _FieldModule(torch.nn.Module):
    """The parameters of a field by name, with "__" for "."; parameters in ``fixed`` have no gradients."""

    def __init__(self, field, fixed: Sequence[str] = ()):
        super().__init__()
        self._field, self._ns = field, field.ns
        self.device_type = "cuda" if is_cuda(self._ns) else "cpu"
        for name, value in field.parameters().items():
            tensor = torch.tensor(value.numpy(), device=self.device_type)
            self.register_parameter(
                name.replace(".", "__"), torch.nn.Parameter(tensor, requires_grad=name not in fixed)
            )

    def _get_parameters(self) -> dict:
        return {name: self.get_parameter(name.replace(".", "__")) for name in self._field.parameters()}

    def field(self):
        """Return a copy of the field with the current weights."""
        out = _copy_with_parameters(self._field, {})
        out.set_parameters({k: self._to_drjit(k, v.detach().cpu().numpy()) for k, v in self._get_parameters().items()})
        return out

    def _to_drjit(self, name: str, value: np.ndarray):
        kind = type(self._field.parameters()[name])
        return kind(value) if dr.is_tensor_v(kind) else kind(value.ravel())

    def _check_rows(self, **tensors) -> list:
        """Check that the inputs are tensors (N, 3) of equal length."""
        count = {len(t) for t in tensors.values() if t.ndim == 2 and t.shape[1] == 3}
        for name, t in tensors.items():
            rows = t.ndim == 2 and t.shape[1] == 3 and len(count) == 1
            if not rows or t.dtype != torch.float32 or t.device.type != self.device_type:
                raise ValueError(
                    f"{name} must be a float32 tensor (N, 3) on {self.device_type} with the same N for all inputs, got "
                    f"{t.dtype} {tuple(t.shape)} on {t.device.type}"
                )
        return [t.contiguous() for t in tensors.values()]

    def _evaluate(self, function, *inputs):
        """Evaluate ``function(field, *arrays)``, which returns a list of rows, as a torch tensor (rows, N).

        Torch ``inputs`` (N, 3) are passed as Array3f, others as lists of their columns.
        """
        ns, field = self._ns, self._field
        tensors = {k for k, v in field.parameters().items() if dr.is_tensor_v(v)}

        @dr.wrap(source="torch", target="drjit")
        def evaluate(values, *points):
            arrays = {k: ns.TensorXf(v) if k in tensors else ns.Float(v.array) for k, v in values.items()}
            attached_field = _copy_with_parameters(field, arrays)
            columns = [_to_columns(ns, p) for p in points]
            out = function(attached_field, *columns)
            return ns.TensorXf(
                dr.ravel(ns.ArrayXf([ns.Float(c) for c in out]), order="C"), (len(out), dr.width(columns[0][0]))
            )

        # dr.wrap accepts tensors but ignores torch.nn.Parameter; a view is a plain tensor.
        return evaluate({k: v.view_as(v) for k, v in self._get_parameters().items()}, *inputs)


class RadianceModule(_FieldModule):
    """Density and colour of a radiance field. The occupancy grid is not applied, so that training in torch can fill
    empty cells.
    """

    def __init__(self, field: RadianceNetwork):
        super().__init__(field)

    def forward(self, p: torch.Tensor, d: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Evaluate density and colour.

        For a deferred field, the colour is that of opaque matter at the point. The colour of a ray is that of its mean
        features (`density_features`, `color`).

        Parameters
        ----------
        p
            Positions (N, 3) in the units of the field.
        d
            Unit viewing directions (N, 3).

        Returns
        -------
        sigma
            Density (N,) in 1/unit.
        color
            Colour (N, 3) in the colour space of the field.
        """

        def evaluate(field, p, d):
            sigma, features = field.density_features(p)
            return [sigma, *field.color(features, d)]

        out = self._evaluate(evaluate, *self._check_rows(p=p, d=d))
        return out[0], out[1:].T

    def density(self, p: torch.Tensor) -> torch.Tensor:
        """Evaluate the density (N,) in 1/unit at positions ``p`` (N, 3); 0 outside of the box."""
        return self._evaluate(lambda field, p: [field.density(p)], *self._check_rows(p=p))[0]

    def density_features(self, p: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Evaluate the density (N,) in 1/unit and the features (N, G), from which `color` computes colours, at
        ``p`` (N, 3).
        """

        def evaluate(field, p):
            sigma, features = field.density_features(p)
            return [sigma, *features]

        out = self._evaluate(evaluate, *self._check_rows(p=p))
        return out[0], out[1:].T

    def color(self, features: torch.Tensor, d: torch.Tensor) -> torch.Tensor:
        """Evaluate the colour (N, 3) of ``features`` (N, G) seen along unit directions ``d`` (N, 3).

        For a deferred field, pass the mean features of a ray, Σ w g / Σ w, and multiply the colour by its opacity Σ w.
        """
        count = self._field.config.geometry
        if features.shape[1:] != (count,):
            raise ValueError(f"features must have shape (N, {count}), got {tuple(features.shape)}")
        (d,) = self._check_rows(d=d)
        return self._evaluate(lambda field, f, d: list(field.color(list(f), d)), features.contiguous(), d).T

    def background(self, o: torch.Tensor, d: torch.Tensor) -> torch.Tensor:
        """Evaluate the background colour (N, 3) of rays from ``o`` (N, 3) along unit directions ``d`` (N, 3)."""
        if self._field.background is None:
            raise ValueError("this field was trained without a background network")
        return self._evaluate(lambda field, o, d: list(field.background(o, d)), *self._check_rows(o=o, d=d)).T


class GazeModule(_FieldModule):
    """The gaze density of a gaze field, normalised over the observer's sphere or not.

    The integral of a normalised field is computed once per observer, over directions of equal solid angle::

        around = Outlook(field, Similarity(), scene, position, settings).trace()  # directions, depths, misses

        Z = module.integral(p_od, p_o, r_o, misses)  # everywhere around the observer
        gaze = module(p_od, p_o, r_o, Z)  # anywhere

    Raises `NergError` for an ensemble; use a `GazeEnsembleModule` for it.
    """

    def __init__(self, field: GazeNetwork):
        if len(field.members) > 1:
            raise NergError(
                f"GazeModule does not support an ensemble of {len(field.members)} gaze fields; use GazeEnsembleModule"
            )
        super().__init__(field, field.fixed)

    def forward(
        self,
        p_od: torch.Tensor,
        p_o: torch.Tensor,
        r_o: torch.Tensor,
        integral: torch.Tensor | float | None = None,
        misses: torch.Tensor | None = None,
        hits: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Evaluate the gaze density (N,) in 1/sr.

        Parameters
        ----------
        p_od
            Positions (N, 3) that are looked at.
        p_o
            Positions (N, 3) of the observers.
        r_o
            Unit directions (N, 3) from ``p_o`` to ``p_od``.
        integral
            Integral of a normalised field over the sphere of each observer, (N,) or one number for all; see `integral`.
        misses
            Boolean mask (N,) of the directions that hit no surface. Default: none.
        hits
            For a field with re-aimed hits, their density (N,), which `evaluate_hits` computes.

        Raises
        ------
        ValueError
            For a normalised field without its integral, a field with re-aimed hits without their density, and tensors
            of the wrong shape.
        """
        if self._field.config.normalized and integral is None:
            raise ValueError(
                'this gaze field is normalised over the observer\'s sphere: pass "integral", which the method '
                "integral computes"
            )
        extra = self._make_extra_rows(len(p_od), 1.0 if integral is None else integral, misses)
        evaluate = lambda field, p, o, r, e: [field.evaluate(p, o, r, integral=e.x, escaped=e.y > 0.5)[0]]
        gaze = self._evaluate(evaluate, *self._check_rows(p_od=p_od, p_o=p_o, r_o=r_o), extra)[0]
        return _mix_hits(self._field, gaze, hits)

    def evaluate_hits(self, p_o: torch.Tensor, r_o: torch.Tensor) -> torch.Tensor:
        """Evaluate the density (N,) in 1/sr of the field's re-aimed hits, without gradients. Arguments as for
        `forward`."""
        return _evaluate_hits(self._field, p_o, r_o)

    def evaluate_unnormalized(
        self, p_od: torch.Tensor, p_o: torch.Tensor, r_o: torch.Tensor, misses: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Evaluate emit times capture (N,), before the division by the integral. Arguments as for `forward`."""

        def product(field, p, o, r, e):
            emit, capture = field.unnormalized(p, o, r, escaped=e.y > 0.5)
            return [emit * capture + dr.zeros(type(e.x), dr.width(e))]

        return self._evaluate(
            product, *self._check_rows(p_od=p_od, p_o=p_o, r_o=r_o), self._make_extra_rows(len(p_od), 1.0, misses)
        )[0]

    def integral(
        self, p_od: torch.Tensor, p_o: torch.Tensor, r_o: torch.Tensor, misses: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Compute the integral over the sphere of one observer, whose position is ``p_o`` in each row.

        The N directions ``r_o`` must have equal solid angles. With the directions of the integrator, the result equals
        the integrator's (``transport.observer_gaze``).
        """
        return 4 * torch.pi * self.evaluate_unnormalized(p_od, p_o, r_o, misses).mean()

    def _make_extra_rows(self, count: int, integral, misses) -> torch.Tensor:
        """Pack integrals and misses into rows (N, 3)."""
        integrals = torch.as_tensor(integral, dtype=torch.float32, device=self.device_type)
        miss_values = (
            torch.zeros(count, dtype=torch.float32, device=self.device_type)
            if misses is None
            else misses.to(torch.float32)
        )
        for name, t in (("integral", integrals), ("escaped", miss_values)):
            if t.numel() != 1 and tuple(t.shape) != (count,):
                raise ValueError(
                    f"{name} must be one number or a tensor of length {count}, one value per row, got {tuple(t.shape)}"
                )
        columns = [integrals.reshape(-1).expand(count), miss_values.reshape(-1).expand(count)]
        return torch.stack([*columns, torch.zeros_like(columns[0])], 1).contiguous()


class GazeEnsembleModule(torch.nn.Module):
    """The mean gaze density of the members of an ensemble. ``members`` are modules (`GazeModule`).

    Each member of a normalised ensemble has its own integral::

        Z = module.integral(p_od, p_o, r_o, misses)  # everywhere around the observer: (members,)
        gaze = module(p_od, p_o, r_o, Z)  # anywhere
        spread = module.forward_members(p_od, p_o, r_o, Z).std(0)
    """

    def __init__(self, field: GazeEnsemble):
        super().__init__()
        self._field = field
        self.members = torch.nn.ModuleList(GazeModule(member) for member in field.members)

    def field(self) -> GazeEnsemble:
        """Return a copy of the ensemble with the current weights."""
        ensemble = GazeEnsemble([member.field() for member in self._get_members()], self._field.support)
        ensemble.basis, ensemble.hits = self._field.basis, self._field.hits
        return ensemble

    def _get_members(self) -> list[GazeModule]:
        return cast("list[GazeModule]", list(self.members))

    def forward_members(
        self,
        p_od: torch.Tensor,
        p_o: torch.Tensor,
        r_o: torch.Tensor,
        integral: torch.Tensor | None = None,
        misses: torch.Tensor | None = None,
        hits: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Evaluate the gaze density (members, N) of each member.

        ``integral`` of a normalised ensemble: (members,) or (members, N). The other arguments and the exceptions are
        those of `GazeModule`.
        """
        if integral is not None and len(integral) != len(self.members):
            raise ValueError(
                f"integral must have one entry for each of the {len(self.members)} members, got {len(integral)}"
            )
        integrals = [None] * len(self.members) if integral is None else integral
        gaze = torch.stack([member(p_od, p_o, r_o, z, misses) for member, z in zip(self._get_members(), integrals)])
        return _mix_hits(self._field, gaze, hits)

    def evaluate_hits(self, p_o: torch.Tensor, r_o: torch.Tensor) -> torch.Tensor:
        """Evaluate the density (N,) of the re-aimed hits; see `GazeModule.evaluate_hits`."""
        return _evaluate_hits(self._field, p_o, r_o)

    def forward(
        self,
        p_od: torch.Tensor,
        p_o: torch.Tensor,
        r_o: torch.Tensor,
        integral: torch.Tensor | None = None,
        misses: torch.Tensor | None = None,
        hits: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Evaluate the gaze density (N,) in 1/sr, the mean over the members."""
        return self.forward_members(p_od, p_o, r_o, integral, misses, hits).mean(0)

    def integral(
        self, p_od: torch.Tensor, p_o: torch.Tensor, r_o: torch.Tensor, misses: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Compute the integral of each member (members,) over the sphere of one observer; see `GazeModule.integral`."""
        return torch.stack([member.integral(p_od, p_o, r_o, misses) for member in self._get_members()])


def _mix_hits(field: GazeNetwork, gaze: torch.Tensor, hits: torch.Tensor | None) -> torch.Tensor:
    """Mix the density ``hits`` (N,) of the re-aimed hits into ``gaze`` (..., N), if the field has them."""
    if field.hits is None:
        return gaze
    if hits is None:
        raise ValueError('this gaze field has re-aimed hits: pass "hits", which the method evaluate_hits computes')
    if hits.shape != gaze.shape[-1:]:
        raise ValueError(
            f"hits must be a tensor of length {gaze.shape[-1]}, one value per row, got {tuple(hits.shape)}"
        )
    return (1 - field.hits.weight) * gaze + field.hits.weight * hits


def _evaluate_hits(field: GazeNetwork, p_o: torch.Tensor, r_o: torch.Tensor) -> torch.Tensor:
    if field.hits is None:
        raise ValueError("this gaze field has no re-aimed hits")
    positions, observer = np.unique(p_o.detach().cpu().numpy(), axis=0, return_inverse=True)
    ns = field.ns
    directions, origins = (to_vector(ns.Array3f, v.detach().cpu().numpy()) for v in (r_o, p_o))
    observed = field.hits.observe(positions, ns)
    density = observed.density(directions, origins, ns.UInt32(copy_aligned(observer.ravel(), np.uint32)))
    return torch.as_tensor(np.array(density), device=p_o.device)


def _to_columns(ns, p):
    rows, count = p.shape
    index = count * dr.arange(ns.UInt32, rows)
    # Each value is read by one point only, so that gradients need no atomic additions.
    columns = [dr.gather(ns.Float, p.array, index + k, mode=dr.ReduceMode.Permute) for k in range(count)]
    return ns.Array3f(*columns) if count == 3 else columns


def _copy_with_parameters(field, values: dict):
    """Return a copy of ``field`` whose parameters are replaced by ``values``, including their gradients."""
    out = _copy_structure(field)
    for owner in {name.partition(".")[0] for name in field.parameters()}:
        if owner.endswith("grid"):
            getattr(out, owner).mode = dr.ReduceMode.Expand
    out.set_parameters(values)
    return out


def _copy_structure(part: Any) -> Any:
    """Return a copy of a part of a field. The copy shares the arrays and the data that ``pack`` derives from them."""
    if isinstance(part, list):
        return [_copy_structure(p) for p in part]
    if isinstance(part, dict):
        return {k: _copy_structure(p) for k, p in part.items()}
    if not hasattr(part, "DRJIT_STRUCT"):
        return part
    out = copy.copy(part)
    for name in part.DRJIT_STRUCT:
        if not name.startswith("_"):
            setattr(out, name, _copy_structure(getattr(part, name)))
    return out
