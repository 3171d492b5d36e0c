"""How long the steps of a training take, and how fast the machine evaluates the field in them."""
from __future__ import annotations

import time

import numpy as np


class StepClock:
    """A context around each step. ``evaluations``: of the field, in steps; ``durations``: of the steps, in seconds.

    Dr.Jit may still be computing when a step ends; the next one then waits for it.
    """

    def __init__(self):
        self.evaluations, self.durations, self._running = 0, [], False

    def __enter__(self) -> StepClock:
        self._running, self._begin = True, time.perf_counter()
        return self

    def __exit__(self, *error) -> None:
        self._running = False
        self.durations.append(time.perf_counter() - self._begin)

    def count(self, evaluations: int) -> None:
        """Add to the evaluations, if there is a step on: others, for looks and bounds, are not timed."""
        if self._running:
            self.evaluations += evaluations

    def summary(self) -> dict:
        """``evaluations_a_second``, and ``step_ms`` with ``min``, ``median`` and ``max``; empty without a step."""
        if not self.durations:
            return {}
        ms = 1e3 * np.array(self.durations)
        numbers = {"min": np.min(ms), "median": np.median(ms), "max": np.max(ms)}
        return {
            "evaluations_a_second": round(self.evaluations / max(sum(self.durations), 1e-9)),
            "step_ms": {name: round(float(x), 1) for name, x in numbers.items()},
        }

    def to_dict(self) -> dict:
        """State for ``restore``."""
        return {"evaluations": self.evaluations, "durations": [round(x, 5) for x in self.durations]}

    def restore(self, state: dict) -> None:
        self.evaluations, self.durations = int(state["evaluations"]), [float(x) for x in state["durations"]]
