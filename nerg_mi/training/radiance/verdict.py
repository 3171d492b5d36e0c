"""What a finished radiance training has to say against itself."""

from __future__ import annotations

# Looks at a few views differ by some tenths of a dB from one another.
_FALL = 1.0
# Fields of photos still gain whole dB with every doubling of their steps below this.
_FEW_STEPS = 500


def complaints(history: list[dict], steps: int, stride: int, minutes: float | None, seconds: float = 0.0) -> list[str]:
    """One sentence for each thing that makes the result worse than it might be; none for a sound run.

    ``history``: looks at the watched views in order, each with ``steps`` and ``psnr`` in dB, the last being that of the
    result; ``steps``: taken; ``stride``: how many times coarser than it is rendered the field was sampled at the end;
    ``minutes``: that were asked for, or None for a run by steps; ``seconds``: that it took.
    """
    out = []
    more = "more --steps" if minutes is None else "more --minutes, or --steps"
    if steps < _FEW_STEPS:
        timed = minutes is not None and seconds > 0
        rate = f" ({steps / seconds:.2g} a second: this machine is slow or busy)" if timed else ""
        out.append(f"only {steps} steps{rate}, where a field needs {_FEW_STEPS} before it is of use; give {more}")
    if stride > 1:
        out.append(
            f"the run ended while marching {stride} times coarser than the field is rendered: fog was not yet cleared; "
            f"give {more}"
        )
    if len(history) > 1:
        best = max(history[:-1], key=lambda x: x["psnr"])
        fall = best["psnr"] - history[-1]["psnr"]
        if fall > _FALL:
            out.append(
                f"the result has {history[-1]['psnr']:.2f} dB on the watched views where step {best['steps']} had "
                f"{best['psnr']:.2f} dB: it is {fall:.1f} dB worse than the run promised; try another --seed, or {more}"
            )
    return out
