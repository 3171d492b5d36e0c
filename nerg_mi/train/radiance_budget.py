"""Time of a radiance training and of its result: part of --minutes, and of the progress that is reported."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from nerg_mi.errors import parameter
from nerg_mi.photos.images import PhotoView

from .radiance_trainer import RadianceTrainer

MIN_SAMPLES, MAX_SAMPLES = 2**21, 2**24
"""Minimum and maximum number of samples of the final error: in fog a ray has hundreds."""

EVALUATION_SAMPLES = 2**19
"""Maximum number of samples of an evaluation of the held-out views during the training, and of training views."""

# Part of the run after which the time of its result is estimated again.
_INTERVAL = 0.05
# Maximum part of --minutes for the result, the part of it for the final error, and a margin of estimates.
_MAX_RESULT, _SCORING, _MARGIN = 0.5, 0.05, 1.2
# Part of the time so far that is assumed to remain for a phase that takes longer than estimated.
_OVERTIME = 0.02


class Budget:
    """Estimates, from measured costs, how long the rest of a run takes.

    Parameters
    ----------
    trainer : RadianceTrainer
        The trainer; with a limit in minutes, time for the result is reserved (`RadianceTrainer.reserve`).
    held_out : sequence of PhotoView
        Views that are scored at the end.
    """

    def __init__(self, trainer: RadianceTrainer, held_out: Sequence[PhotoView]):
        self._trainer, self._held_out = trainer, held_out
        self._evaluation_seconds, self._samples_per_second = 0.0, 0.0
        self._next, self._fraction = trainer.progress + _INTERVAL, 0.0
        self._limit = None if trainer.settings.minutes is None else 60 * trainer.settings.minutes
        # End of the estimated time of the result, on the clock of the trainer, once it is made
        self._end: float | None = None
        # Start and estimated duration of the extraction, and the estimated time after it
        self._extraction = self._after = self._result_start = 0.0
        self._is_warned = False

    @contextmanager
    def timing_evaluation(self, views: Sequence[PhotoView]) -> Iterator[list[int]]:
        """Measure an evaluation of ``views``; its pixel stride is appended to the list."""
        start, strides = time.perf_counter(), []
        yield strides
        self._evaluation_seconds = time.perf_counter() - start
        if strides and views:
            samples = sum(map(self._trainer.estimate_samples, views)) / strides[0] ** 2
            self._samples_per_second = samples / max(self._evaluation_seconds, 1e-9)

    def update(self) -> str | None:
        """Reserve time for the result at intervals of the run; call this after each step.

        Returns a warning, once, if the result does not fit into the limit.
        """
        if self._limit is None or self._trainer.progress < self._next:
            return None
        self._next = self._trainer.progress + _INTERVAL
        needed = _MARGIN * self._choice_seconds + self._scoring_seconds
        reserved = min(needed, _MAX_RESULT * self._limit)
        self._trainer.reserve(reserved)
        if needed <= reserved or self._is_warned:
            return None
        self._is_warned = True
        return (
            f"the occupancy and the scores of the result take about {needed:.0f} s, so that the run will take "
            f"about {(self._limit + needed - reserved) / 60:.2g} minutes: give it more {parameter('minutes')}"
        )

    @property
    def _choice_seconds(self) -> float:
        """Seconds until the result is chosen: extraction of the occupancy, and an evaluation."""
        # A short run ends before the first evaluation, which is then estimated from the cost of the density.
        unmeasured = 2 * EVALUATION_SAMPLES * self._trainer.seconds_per_density if self._held_out else 0.0
        return self._trainer.estimate_extraction_seconds() + (self._evaluation_seconds or unmeasured)

    @property
    def _scoring_seconds(self) -> float:
        """Seconds that are reserved for the final error: a part of the limit, or what its fewest samples take."""
        if self._limit is None or not self._held_out:
            return 0.0
        fewest = min(sum(map(self._trainer.estimate_samples, self._held_out)), MIN_SAMPLES)
        fewest_seconds = fewest / self._samples_per_second if self._samples_per_second else 0.0
        return max(_SCORING * self._limit, fewest_seconds)

    def choose_final_samples(self) -> int:
        """Choose the maximum number of samples of the final error, so that it ends within the limit."""
        if self._limit is None or not self._samples_per_second:
            return MAX_SAMPLES
        left = max(self._limit - self._trainer.seconds, _SCORING / 2 * self._limit)
        return int(min(max(left * self._samples_per_second, MIN_SAMPLES), MAX_SAMPLES))

    def start_result(self) -> None:
        """Start the estimated time of the result, after the last step."""
        self._result_start, duration = self._trainer.seconds, self._result_seconds
        self._extraction = self._trainer.estimate_extraction_seconds()
        self._after = max(duration - self._extraction, 0.0)
        self._end = self._result_start + duration

    def update_extraction(self, part: float) -> None:
        """Estimate the end again after a ``part`` of the extraction of the occupancy, from the time that it took."""
        measured = (self._trainer.seconds - self._result_start) / max(part, 1e-9)
        self._end = self._result_start + part * measured + (1 - part) * self._extraction + self._after

    @property
    def _result_seconds(self) -> float:
        if self._limit is not None and self._end is None:
            return self._trainer.reserved_seconds
        samples = min(sum(map(self._trainer.estimate_samples, self._held_out)), self.choose_final_samples())
        return self._choice_seconds + (samples / self._samples_per_second if self._samples_per_second else 0.0)

    def estimate(self, part: float = 0.0) -> tuple[float, float]:
        """Return the completed fraction of the whole run, which never falls, and the seconds that remain.

        ``part`` is the completed part of the present phase after the last step.
        """
        seconds, progress = self._trainer.seconds, self._trainer.progress
        if self._end is not None:
            remaining = max(self._end - seconds, _OVERTIME * seconds) * (1 - part)
        elif self._limit is not None:
            remaining = max(self._limit - seconds, self._result_seconds)
        else:
            remaining = seconds * (1 - progress) / max(progress, 1e-6) + self._result_seconds
        remaining = max(remaining, 0.005 * seconds)
        self._fraction = max(self._fraction, seconds / max(seconds + remaining, 1e-9))
        return self._fraction, remaining
