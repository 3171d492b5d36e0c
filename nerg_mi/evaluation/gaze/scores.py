"""A trained gaze field beside its baselines: densities over the sphere at positions, and a table of scores."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.evaluation import saliency as metrics
from nerg_mi.fields.gaze_base import AnyGazeField
from nerg_mi.maths.arrays import vector_of
from nerg_mi.maths.geometry import Similarity
from nerg_mi.train.gaze_data import SURFACE_OPACITY
from nerg_mi.transport.geometry import Place, default_settings
from nerg_mi.transport.observer import ObserverSettings
from nerg_mi.transport.observer_gaze import ObservedGaze, PlacedGaze

# Of the uniform density: what a density of zero counts as in KLD. A truth that is a kernel density has
# long empty stretches where nothing should hinge on how empty exactly.
EPS = 1e-6


class FieldDensity:
    """A gaze field in a place, as a function as those of `baselines` are; see `gaze_field`."""

    def __init__(
        self,
        field: AnyGazeField,
        place: Place,
        align: Similarity,
        settings: ObserverSettings,
        on_position: Callable[[int], None] | None,
    ):
        self._gaze, self._place, self._align, self._settings = PlacedGaze(field), place, align, settings
        self._on_position = on_position
        self._observed: dict[bytes, ObservedGaze] = {}

    def __call__(self, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Densities (P, D) of positions (P, 3) in unit directions (D, 3) or (P, D, 3)."""
        return self.members(positions, directions).mean(axis=0)

    def members(self, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """The same of each member of an ensemble (M, P, D); of one field, that alone."""
        align = self._align
        positions = np.atleast_2d(np.asarray(positions, np.float64)) @ align.matrix[:3, :3].T + align.matrix[:3, 3]
        directions = np.asarray(directions, np.float64) @ (align.matrix[:3, :3] / align.scale).T
        directions = np.broadcast_to(directions, (len(positions), *directions.shape[-2:]))
        return np.stack([self._of(p, d) for p, d in zip(positions, directions)], axis=1)

    def _of(self, position: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Densities (M, D) of one observer (3,), both in the field's frame."""
        import mitsuba as mi

        p_o, key = mi.Point3f(*position.tolist()), position.tobytes()
        new = key not in self._observed
        if new:
            self._observed[key] = self._gaze.at([p_o], self._place, self._settings)
        r_o = vector_of(mi.Vector3f, directions)
        density = np.stack([np.array(m) for m in self._observed[key].members_along(p_o, r_o)])
        if new and self._on_position is not None:
            self._on_position(len(self._observed))
        return density


def gaze_field(
    field: AnyGazeField,
    medium,
    align: Similarity | None = None,
    kind: str = "median",
    on_position: Callable[[int], None] | None = None,
) -> FieldDensity:
    """``field`` in a place as a function ``(positions (P, 3), directions) -> (P, D)`` of densities in 1/sr of the
    positions' units.

    What the integrator ``nerg`` shows on surfaces for an observer there, by the same functions: its depths, its
    integral of a normalised field, its mean of an ensemble. Where no surface is met the field is what it was trained to
    be there.

    ``medium``: what the observer's depth is traced in, in the field's frame (a medium or a ``Place``; None for a field
    that knows no geometry); ``align``: similarity from the frame of the positions to the field's; directions (D, 3) for
    all positions or (P, D, 3), unit. The integrals of positions are kept: neither the field nor its place may change.
    ``on_position`` is told how many positions are known, after each new one. Raises `NergError` for a field that needs
    surfaces where there is no place.
    """
    if medium is None and field.config.needs_surfaces:
        raise NergError(
            "this gaze field was trained among surfaces, and there is no place that has any: give it the field, the "
            "scene or the geometry"
        )
    place = medium if isinstance(medium, Place) else Place(medium)
    settings = ObserverSettings(march=default_settings(place), depth=kind, surface_opacity=SURFACE_OPACITY)
    return FieldDensity(field, place, align or Similarity(), settings, on_position)


def scores(truth: np.ndarray, prediction: np.ndarray, eps: float = EPS) -> dict[str, float]:
    """Means over positions of KLD (nats, both normalised over the sphere), CC, SIM, MAE (1/sr) and the prediction's
    integral.

    ``truth``, ``prediction``: (P, D) in 1/sr, directions of equal area; ``eps`` as in ``metrics.kld``. MAE and the
    integral are of the prediction as it is, not normalised.
    """
    return {
        "KLD": float(metrics.kld(truth, prediction, eps=eps).mean()),
        "CC": float(metrics.cc(truth, prediction).mean()),
        "SIM": float(metrics.sim(truth, prediction).mean()),
        "MAE": float(metrics.mae(truth, prediction).mean()),
        "integral": float(4 * np.pi * np.mean(prediction)),
    }


def score_rows(
    truth: np.ndarray, positions: np.ndarray, directions: np.ndarray, methods: dict[str, Callable]
) -> list[dict]:
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
