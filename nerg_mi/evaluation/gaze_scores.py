"""A trained gaze field beside its baselines: densities over the sphere at positions, and a table of scores."""
from __future__ import annotations

from typing import Callable

import drjit as dr
import numpy as np

from ..attention.sphere import fibonacci_directions
from ..field.backend import namespace
from ..field.gaze import GazeField
from ..field.gaze_ensemble import GazeEnsemble
from ..field.log_gaze import LogGazeField
from ..training.gaze_semantics import semantic_features
from ..training.gaze_supervision import surfaces
from ..transport.media import Similarity
from . import metrics
from .gaze_baselines import Baseline

# Of the uniform density: what a density of zero counts as in KLD. A truth that is a kernel density has
# long empty stretches where nothing should hinge on how empty exactly.
EPS = 1e-6
_CHUNK = 1 << 18
SPHERE = 2048
"""Directions of the integral that normalises a field."""


def gaze_field(field: GazeField | LogGazeField | GazeEnsemble, medium, align: Similarity | None = None, kind: str = "median",
               count: int = SPHERE) -> Baseline:
    """``field`` in a place as a function ``(positions (P, 3), directions) -> (P, D)`` of densities in 1/sr; normalised where the
    field says so, by its integral over ``count`` directions of equal area.

    ``medium``: what the observer's depth is traced in, in the field's frame (see ``training.gaze_supervision.surfaces``);
    ``align``: similarity from the frame of the positions to the field's; directions (D, 3) for all positions or (P, D, 3).
    Where no surface is met the field is what it was trained to be there. Of an ensemble it is the members' mean.
    """
    if isinstance(field, GazeEnsemble):
        members = [gaze_field(m, medium, align, kind, count) for m in field.members]
        return lambda positions, directions: np.mean([m(positions, directions) for m in members], axis=0)
    align = align or Similarity()
    ns, config = namespace(field.grid.table), field.config
    fill = getattr(config, "escaped", None) == "nearest"
    sphere, known = fibonacci_directions(count) if config.normalized else np.empty((0, 3)), {}

    def evaluate(positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        positions = np.atleast_2d(np.asarray(positions, np.float64)) @ align.matrix[:3, :3].T + align.matrix[:3, 3]
        directions = np.asarray(directions, np.float64) @ (align.matrix[:3, :3] / align.scale).T
        directions = np.broadcast_to(directions, (len(positions), *directions.shape[-2:]))
        # The sphere comes along: where a place has holes, it says what surrounds a direction.
        new = config.normalized and positions.tobytes() not in known
        more = np.broadcast_to(sphere, (len(positions), *sphere.shape)) if new or fill else directions[:, :0]
        out, blind = _densities(field, medium, positions, np.concatenate([more, directions], axis=1), kind, fill, ns)
        N = more.shape[1]
        if config.normalized:
            if new:
                known.clear()
                known[positions.tobytes()] = 4 * np.pi * out[:, :N].mean(axis=1, dtype=np.float64, keepdims=True)
            out = out / known[positions.tobytes()]
            if getattr(config, "mix", 0):
                out = (1 - config.mix) * out + config.mix * blind
        return out[:, N:].astype(np.float32)

    return evaluate


def _densities(field, medium, positions, directions, kind, fill, ns) -> tuple[np.ndarray, np.ndarray]:
    """Unnormalised densities and, of a log density, the blind one, (P, D) each."""
    distance, escaped = surfaces(medium, field.box, positions, directions, kind, fill)
    D, log = directions.shape[1], hasattr(field, "log_blind")
    out, blind = np.zeros((2, distance.size))
    o, d = np.repeat(positions, D, axis=0).astype(np.float32), directions.reshape(-1, 3).astype(np.float32)
    for a in range(0, distance.size, _CHUNK):
        part = slice(a, a + _CHUNK)
        p_o, r_o = (ns.Array3f(np.ascontiguousarray(v[part].T)) for v in (o, d))
        p_od = p_o + r_o * ns.Float(distance.ravel()[part])
        with dr.suspend_grad():
            semantic = None
            if field.config.semantic:
                features = semantic_features(medium, o[part], d[part], distance.ravel()[part], field.config.semantic)
                semantic = [ns.Float(np.ascontiguousarray(f, np.float32)) for f in features.T]
            emit, capture = field.unnormalized(p_od, p_o, r_o, True, semantic, escaped=ns.Bool(escaped.ravel()[part]))
            # A constant variant returns one lane for all.
            out[part] = np.asarray(emit * capture + dr.zeros(ns.Float, dr.width(r_o)))
            if log:
                blind[part] = np.asarray(dr.exp(field.log_blind(r_o)))
    return out.reshape(distance.shape), blind.reshape(distance.shape)


def scores(truth: np.ndarray, prediction: np.ndarray, eps: float = EPS) -> dict[str, float]:
    """Means over positions of KLD (nats, both normalised over the sphere), CC, SIM, MAE (1/sr) and the prediction's integral.

    ``truth``, ``prediction``: (P, D) in 1/sr, directions of equal area; ``eps`` as in ``metrics.kld``. MAE and the integral
    are of the prediction as it is, not normalised.
    """
    return {
        "KLD": float(metrics.kld(truth, prediction, eps=eps).mean()), "CC": float(metrics.cc(truth, prediction).mean()),
        "SIM": float(metrics.sim(truth, prediction).mean()), "MAE": float(metrics.mae(truth, prediction).mean()),
        "integral": float(4 * np.pi * np.mean(prediction)),
    }  # fmt: skip


def score_rows(truth: np.ndarray, positions: np.ndarray, directions: np.ndarray, methods: dict[str, Callable]) -> list[dict]:
    """One row of ``scores`` for each of ``methods`` (name: density function), in order; ``method`` holds the name."""
    return [{"method": name, **scores(truth, density(positions, directions))} for name, density in methods.items()]


def print_scores(rows: list[dict], title: str) -> None:
    """Print ``rows`` as a table."""
    from rich.console import Console
    from rich.table import Table

    out = Table(title=title, title_justify="left")
    for k in rows[0]:
        out.add_column(k, justify="left" if isinstance(rows[0][k], str) else "right")
    for row in rows:
        out.add_row(*(v if isinstance(v, str) else f"{v:.4f}" if k == "MAE" else f"{v:.3f}" for k, v in row.items()))
    # A width of its own: a table in a file or a pipe must not be folded.
    Console(width=120).print(out)
