"""Measurement: alternating runs, medians with their spread, and scaling exponents."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tools import results
from tools.results import save as save_result

__all__ = ["Times", "at_the_end", "exponent", "in_turns", "median", "results", "save_result", "spread"]


median = statistics.median

_SETTLE = 0.05
"""Seconds after which spinning threads sleep."""

Times = list[tuple[float, float]]
"""Seconds of each run: wall-clock, and CPU."""


def in_turns(works: Mapping[str, Callable[[], object]], runs: int, warm: int = 1) -> dict[str, Times]:
    """Times of ``runs`` calls of each of ``works``, which alternate after ``warm`` calls that compile and fill caches,
    so that other load of the machine affects all equally."""
    for work in works.values():
        for _ in range(warm):
            work()
    taken: dict[str, Times] = {name: [] for name in works}
    for _ in range(runs):
        for name, work in works.items():
            # Threads of the previous work spin for a while before they sleep: Dr.Jit's, PyTorch's, OpenBLAS's.
            time.sleep(_SETTLE)
            wall, cpu = time.perf_counter(), time.process_time()
            work()
            taken[name].append((time.perf_counter() - wall, time.process_time() - cpu))
    return taken


def spread(values: Iterable[float]) -> str:
    """The first and the third quartile."""
    low, high = np.quantile(list(values), (0.25, 0.75))
    return f"{low:.3g}, {high:.3g}"


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """The b of cost = a size^b that fits best in logarithms: 1 for a proportional cost."""
    return float(np.polyfit(np.log(np.asarray(sizes, float)), np.log(np.asarray(costs, float)), 1)[0])


def at_the_end(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """`exponent` between the two largest sizes, where the constant cost of a call matters least."""
    return exponent(sizes[-2:], costs[-2:])
