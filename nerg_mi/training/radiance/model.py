"""The radiance field's forward pass in the form that trains fastest: networks as tensor products."""

from __future__ import annotations

import drjit as dr

from nerg_mi.fields.encoding import encode_direction, encoding_of
from nerg_mi.fields.mlp import MLP
from nerg_mi.fields.radiance import (
    RadianceConfig,
    density_from_log,
    mean_features,
    network_color,
    network_inputs,
    point_features,
)
from nerg_mi.maths.geometry import AnyBox


def stack(rows: list, ns):
    """Rows (Floats of one length, or constants) as a TensorXf (N, rows)."""
    flat = dr.ravel(ns.ArrayXf(rows), order="F")
    return ns.TensorXf(flat, (dr.width(flat) // len(rows), len(rows)))


def unstack(x, ns) -> list:
    """Columns of a TensorXf (N, rows) as Floats.

    A plain slice would send its gradient back through atomic additions; no two columns share an
    entry, so that ``Permute`` (plain stores) is right.
    """
    width, rows = x.shape
    index = dr.arange(ns.UInt32, width)
    return [
        dr.gather(ns.Float, x.array, index * rows + dr.opaque(ns.UInt32, k), mode=dr.ReduceMode.Permute)
        for k in range(rows)
    ]


def density_summand(config: RadianceConfig, box: AnyBox, parameters: dict, p, d, ns, features: list | None = None):
    """Density (1/unit) at world points ``p`` seen along ``d``, and what a ray composites of them (list of Floats):
    colour (3 in 0..1), or of a deferred field the features that `ray_color` makes colour of.

    The same maths as ``RadianceField.density_features`` and ``color`` on ``parameters`` spelt as the field spells them;
    points must lie in ``box``. Gradients reach every entry of ``parameters``. ``features``: what the grid returns at
    ``p``, where that has been looked up already.
    """
    h = unstack(_net(parameters, "density_net").tensor(_features(config, box, parameters, p, ns, features)), ns)
    sigma = box.density_along(density_from_log(h[0], config.density_scale), p)
    features = point_features(h[1:], config.deferred)
    return sigma, features if config.deferred else _color(config, parameters, features, d, ns)


def ray_color(config: RadianceConfig, parameters: dict, sums: list, opacity, d, ns) -> list:
    """Colour (3 Floats, times opacity) of rays along ``d`` that composited ``sums`` of what `density_summand` returns,
    with this ``opacity``."""
    if not config.deferred:
        return sums
    return [opacity * c for c in _color(config, parameters, mean_features(sums, opacity), d, ns)]


def _color(config: RadianceConfig, parameters: dict, features: list, d, ns) -> list:
    given = network_inputs(features, config.deferred)
    c = _net(parameters, "color_net").tensor(stack(encode_direction(d, config.sh_degree) + given, ns))
    return network_color(unstack(c, ns), given, config.deferred)


def density(config: RadianceConfig, box: AnyBox, parameters: dict, p, ns):
    """Density (1/unit) alone, at world points ``p`` in ``box``; see `density_summand`."""
    head = _head(parameters)
    log_density = head.tensor(_features(config, box, parameters, p, ns)).array
    return box.density_along(density_from_log(log_density, config.density_scale), p)


def density_of(config: RadianceConfig, box: AnyBox, parameters: dict, p, features: list):
    """Density (1/unit) at ``p`` where the grid returns ``features`` (list of Floats); without weight gradients, as one
    kernel."""
    return box.density_along(density_from_log(_head(parameters)(features)[0], config.density_scale), p)


def _head(parameters: dict) -> MLP:
    net = _net(parameters, "density_net")
    return MLP(net.weights[:-1] + [net.weights[-1][0:1, :]])


def _features(config: RadianceConfig, box: AnyBox, parameters: dict, p, ns, known: list | None = None):
    rows = encoding_of(config.grid, parameters, mode=dr.ReduceMode.Expand)(box.to_unit(p))
    return stack(rows if known is None else [dr.replace_grad(a, b) for a, b in zip(known, rows)], ns)


def _net(parameters: dict, name: str) -> MLP:
    count = sum(k.startswith(name + ".") for k in parameters)
    return MLP([parameters[f"{name}.{i}"] for i in range(count)])
