"""The unit and the column of time."""

from __future__ import annotations

import numpy as np

from .figures import Figures
from .protocol import check

_USUAL = 5.0, 2100.0  # rays a second of devices that there are


@check("speeds that nobody walks, rates of rays that no device has, times that never change (`--tick`, `--map t=`)")
def check_times(figures: Figures) -> list[str]:
    """The unit and the column of time, by the speeds of the origins and the rate of rays."""
    speed, step, out = figures.speed, figures.step, []
    if speed > 5:
        out.append(
            f"5 % of the steps are faster than {speed:.1f} m/s, no walking pace: "
            "check the unit of time (--tick) or length"
        )
    if step is None or np.isnan(step):
        if step is not None:
            out.append(
                "all rays of a person have the same time: is it the column of times that was named? (--map t=...)"
            )
        return out
    # Where most rays come more than a second apart hardly anything counts as recorded time.
    if not 1e-4 <= step <= 1.0:
        tick = figures.rays.metadata.get("tick", 1.0)
        fits = [f for f in (1e-3, 1e-6, 1e-7, 1e-9, 1e3, 60.0) if _USUAL[0] <= 1 / (step * f) <= _USUAL[1]]
        remedy = "check the unit of time (--tick)"
        if fits:
            unit, rate = tick * fits[0], 1 / (step * fits[0])
            remedy = f"were a unit of the file's time {unit:g} s, it would be {rate:.3g} a second (--tick {unit:g})"
        out.append(f"a ray comes every {step:.3g} s; {remedy}")
    return out
