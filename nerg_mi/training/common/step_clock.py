"""How long the steps of a training take, and how fast the machine evaluates the field in them."""

from __future__ import annotations

import time

import numpy as np

KEPT = 1 << 12
"""Durations that are kept at most: the state of a run of days must stay small enough to be read again."""


class StepClock:
    """A context around each step. ``evaluations``: of the field, in steps; ``steps`` and ``seconds``: of all of them;
    ``extremes``: the shortest and the longest, in seconds; ``durations``: of every ``each``-th, for the median.

    Dr.Jit may still be computing when a step ends; the next one then waits for it.
    """

    def __init__(self):
        self.evaluations, self.steps, self.seconds, self.each = 0, 0, 0.0, 1
        self.extremes, self.durations, self._running = [float("inf"), 0.0], [], False

    def __enter__(self) -> StepClock:
        self._running, self._begin = True, time.perf_counter()
        return self

    def __exit__(self, *error) -> None:
        self._running = False
        self.add(time.perf_counter() - self._begin)

    def add(self, seconds: float) -> None:
        """One more step, of so many ``seconds``."""
        if self.steps % self.each == 0:
            self.durations.append(seconds)
        self.steps, self.seconds = self.steps + 1, self.seconds + seconds
        self.extremes = [min(self.extremes[0], seconds), max(self.extremes[1], seconds)]
        if len(self.durations) > KEPT:
            self.durations, self.each = self.durations[::2], 2 * self.each

    def count(self, evaluations: int) -> None:
        """Add to the evaluations, if there is a step on: others, for looks and bounds, are not timed."""
        if self._running:
            self.evaluations += evaluations

    def summary(self) -> dict:
        """``evaluations_a_second``, and ``step_ms`` with ``min``, ``median`` and ``max``; empty without a step."""
        if not self.steps:
            return {}
        ms = {"min": self.extremes[0], "median": np.median(self.durations), "max": self.extremes[1]}
        return {
            "evaluations_a_second": round(self.evaluations / max(self.seconds, 1e-9)),
            "step_ms": {name: round(1e3 * float(value), 1) for name, value in ms.items()},
        }

    def to_dict(self) -> dict:
        """State for ``restore``."""
        return {
            "evaluations": self.evaluations,
            "steps": self.steps,
            "seconds": self.seconds,
            "each": self.each,
            "extremes": self.extremes if self.steps else [],
            "durations": [round(x, 5) for x in self.durations],
        }

    def restore(self, state: dict) -> None:
        self.evaluations, self.steps, self.each = (int(state[name]) for name in ("evaluations", "steps", "each"))
        self.seconds, self.durations = float(state["seconds"]), [float(x) for x in state["durations"]]
        self.extremes = [float(x) for x in state["extremes"]] or [float("inf"), 0.0]
        if self.steps < 0 or self.each < 1 or len(self.extremes) != 2 or bool(self.durations) != bool(self.steps):
            raise ValueError('its "clock" is not one of a run')
