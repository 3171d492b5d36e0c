"""Real spherical harmonics as an encoding of directions.

Order and signs are those of instant-ngp and torch-ngp (Condon-Shortley phase,
l = 0..3, m = -l..l), which Dr.Jit's ``sh_eval`` shares.
"""

from __future__ import annotations

import drjit as dr


def encode_direction(d, degree: int = 4) -> list:
    """The ``degree**2`` harmonics (list of Floats) of a unit direction ``d`` (Array3f)."""
    if not 1 <= degree <= 10:
        raise ValueError(f"the degree of the direction encoding must lie in 1..10, got {degree}")
    return list(dr.sh_eval(d, degree - 1))
