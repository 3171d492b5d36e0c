"""How much one step of a radiance training takes on, from what the last one found.

Everything here follows the number of samples, and nothing the clock: equal steps do equal work on every machine.
"""

from __future__ import annotations

# Fewer rays a step are too noisy to learn from; marching waits to get finer until so many are affordable.
FEW_RAYS = 256
_MOST_RAYS, _LEAST_RAYS = 2**14, 64
# A batch that is filled to this share seldom overflows, and what overflows is dropped.
_FILLED = 0.95


def adapted_rays(rays: int, kept: float, looked: float, batch: int, most: int) -> int:
    """Rays of the next step: as many as fill a batch of ``batch`` samples, or the ``most`` of the density-only pass.

    ``rays``: of the last step; ``kept``, ``looked``: samples a ray in its batch, and in the pass before it.
    """
    wanted = _FILLED * min(batch / max(kept, 1e-3), most / max(looked, 1e-3))
    # Damped, because a batch of few rays is a noisy estimate.
    wanted = min(max(0.5 * (rays + wanted), rays / 2), 2 * rays)
    return int(min(max(wanted, _LEAST_RAYS), _MOST_RAYS))


def affordable_rays(rays: int, looked: float, steps: int, most: int, candidates: int) -> int:
    """``rays``, or as many of them as keep the density-only pass within ``most`` samples and their ``steps`` each
    within ``candidates``.

    ``looked``: samples a ray that the pass is expected to look at.
    """
    return max(1, min(rays, int(_FILLED * most / max(looked, 1e-3)), candidates // steps))


def refined(stride: int, strides: tuple[int, ...], scheduled: int, looked: float, most: int, waits: bool = True) -> int:
    """The stride of the next step: ``stride``, or the next finer one of ``strides`` and 1.

    It is refined when the schedule has come to a finer one (``scheduled``), and free space is cleared far enough that
    the pass has room for ``FEW_RAYS`` rays at it. ``looked``: samples a ray that the pass last looked at, at
    ``stride``;
    ``most``: of its samples a step. ``waits``: False refines without regard to what is cleared.
    """
    if scheduled >= stride:
        return stride
    finer = max(s for s in (*strides, 1) if s < stride)
    fits = looked * stride / finer * FEW_RAYS <= most
    return finer if fits or not waits else stride
