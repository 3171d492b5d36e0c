r"""Smoothing along a surface: attention flows as heat does, over edges and never through the air.

Heat that starts at a point of a plane has, after the time t = s² / 2, the density of a Gaussian with the standard
deviation s along both axes. On a mesh M du/dt = -L u, with the areas M of vertices and the Laplacian L, is solved in n
equal steps backwards in time (Crane, Weischedel, Wardetzky, "Geodesics in Heat", 2013, take one): each solves
(M + t/n L) u = M u_before. No step makes a density negative, whatever the mesh, all of them together change no total,
and where no edge leads nothing arrives, exactly. Backwards in time a Gaussian comes out with the right variance and, to
the order 1/n, with longer tails.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from .laplacian import laplacian
from .mesh import Mesh

STEPS = 8
"""Steps in time."""


class Smoother:
    """Smoothing of densities on ``mesh`` by ``length``, the standard deviation s along the surface in scene units."""

    def __init__(self, mesh: Mesh, length: float, steps: int = STEPS):
        if not (np.isfinite(length) and length > 0 and steps >= 1):
            raise ValueError(f"smoothing needs a positive length and a step at least, got {length} and {steps}")
        self._steps = steps
        area = mesh.vertex_area
        # In units in which neither areas nor times of tiny or huge places vanish.
        unit = float(area.mean())
        self._area = area / unit
        matrix = sparse.diags_array(self._area) + (0.5 * length**2 / steps / unit) * laplacian(mesh)
        # Without pivots: a matrix with such signs needs none, and its factors then keep them, so that no density
        # becomes negative. Other components are other blocks, which nothing of this one reaches.
        self._solve = splu(
            matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        ).solve

    def __call__(self, amount: np.ndarray) -> np.ndarray:
        """The integrals over hat functions ``amount`` (V,) of an attention, after smoothing; their sum stays."""
        heat = np.asarray(amount, np.float64)
        for _ in range(self._steps):
            heat = self._area * self._solve(heat)
        return heat
