"""The networks of both fields in float64 NumPy: harmonics by their formulas, layers as matrix products, equation 1."""

import numpy as np

from . import hashgrid_numpy


def harmonics(d):
    """(N, 16) real spherical harmonics of unit ``d`` (N, 3): l = 0..3, m = -l..l, with the Condon-Shortley phase."""
    x, y, z = np.asarray(d, np.float64).T
    r = np.sqrt
    pi = np.pi
    return np.stack(
        [
            r(1 / pi) / 2 + 0 * x,
            -r(3 / (4 * pi)) * y,
            r(3 / (4 * pi)) * z,
            -r(3 / (4 * pi)) * x,
            r(15 / pi) / 2 * x * y,
            -r(15 / pi) / 2 * y * z,
            r(5 / pi) / 4 * (3 * z**2 - 1),
            -r(15 / pi) / 2 * x * z,
            r(15 / pi) / 4 * (x**2 - y**2),
            -r(35 / (2 * pi)) / 4 * y * (3 * x**2 - y**2),
            r(105 / pi) / 2 * x * y * z,
            -r(21 / (2 * pi)) / 4 * y * (5 * z**2 - 1),
            r(7 / pi) / 4 * z * (5 * z**2 - 3),
            -r(21 / (2 * pi)) / 4 * x * (5 * z**2 - 1),
            r(105 / pi) / 4 * z * (x**2 - y**2),
            -r(35 / (2 * pi)) / 4 * x * (x**2 - 3 * y**2),
        ],
        axis=-1,
    )


def mlp(x, weights):
    """(N, outputs) of a network without biases, ReLU between its layers; ``weights``: (outputs, inputs) each."""
    for i, w in enumerate(weights):
        x = x @ np.asarray(w, np.float64).T
        if i + 1 < len(weights):
            x = np.maximum(x, 0)
    return x


def sigmoid(x):
    return np.where(x >= 0, 1 / (1 + np.exp(-np.abs(x))), np.exp(-np.abs(x)) / (1 + np.exp(-np.abs(x))))


def to_unit(p, lower, upper):
    lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    return (np.asarray(p, np.float64) - (lower + upper) / 2) / np.max(upper - lower) + 0.5


def _grid(p, parameters, grid, lower, upper):
    table = np.asarray(parameters["grid.table"], np.float64).reshape(-1, grid["features"])
    return hashgrid_numpy.features(to_unit(p, lower, upper), table, **grid)


def _net(parameters, name):
    return [parameters[f"{name}.{i}"] for i in range(10) if f"{name}.{i}" in parameters]


def radiance(p, d, parameters, grid, lower, upper, degree=4, scale=1.0):
    """``(density (N,), colour (N, 3))``: density 0 outside of the box; exponent clamped at 30."""
    h = mlp(_grid(p, parameters, grid, lower, upper), _net(parameters, "density_net"))
    inside = np.all((p >= np.asarray(lower)) & (p <= np.asarray(upper)), axis=-1)
    sigma = np.where(inside, scale * np.exp(np.minimum(h[:, 0], 30)), 0)
    x = np.concatenate([harmonics(d)[:, : degree**2], h[:, 1:]], axis=-1)
    return sigma, sigmoid(mlp(x, _net(parameters, "color_net")))


def gaze(p_od, p_o, r_o, parameters, grid, lower, upper, variant, activation, degree=4):
    """``(G, F_e, sigmoid F_c)`` of equation 1; a factor that the variant lacks is 1."""

    def trunk(p, d):
        geometry = mlp(_grid(p, parameters, grid, lower, upper), _net(parameters, "position_net"))
        x = np.concatenate([harmonics(d)[:, : degree**2], geometry], axis=-1)
        return np.maximum(mlp(x, _net(parameters, "direction_net")), 0)

    activate = {"softplus": lambda x: np.logaddexp(0, x), "exp": np.exp, "linear": lambda x: x}[activation]
    one = np.ones(len(p_od))
    emit = one if variant == "capture" else activate(mlp(trunk(p_od, -r_o), _net(parameters, "emit_head"))[:, 0])
    capture = one if variant == "emit" else sigmoid(mlp(trunk(p_o, r_o), _net(parameters, "capture_head"))[:, 0])
    return emit * capture, emit, capture
