"""Common parts of radiance and gaze training: the loop over steps, averaged weights, run state, step clock."""

from __future__ import annotations

import json
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.files.safe_read import translate_read_errors
from nerg_mi.files.schema import Items, Number, check_json
from nerg_mi.formats.fields import read_number
from nerg_mi.interruption import Interrupted, Interruption

from .radiance_settings import RunSettings

# ---- Trainer ----


def learning_rate_at(settings: RunSettings, progress: float) -> float:
    """Return the learning rate at ``progress`` in 0..1 of a run."""
    late = max(0.0, progress - settings.lr_hold_fraction) / (1 - settings.lr_hold_fraction)
    return settings.learning_rate * settings.lr_final_ratio ** min(late, 1.0)


class Trainer(ABC):
    """Base class of a training run: optimiser, averaged weights (the result) and clock.

    ``schedule`` is the number of steps that the learning-rate schedule spans, if it differs from the length of the run.
    """

    AVERAGE_INTERVAL: ClassVar[int] = 1  # Steps between two updates of the average

    def __init__(self, settings: Any, ns: ModuleType, schedule: int | None = None):
        self.settings, self.ns, self._schedule = settings, ns, schedule
        self.rng = np.random.default_rng(settings.seed)
        self.steps = 0
        # Seconds of a limit in minutes that are left for the result; the time and the progress at which this was set
        self.reserved_seconds, self._reserved_at = 0.0, (0.0, 0.0)
        self.optimiser: Any = None
        self.averaged: dict[str, Any] = {}

    def start(self, optimiser: Any = None) -> None:
        """Start the clock of the run and, if given, train the weights of ``optimiser`` (Adam or AdamW)."""
        if optimiser is not None:
            self.optimiser = optimiser
            self.averaged = {k: type(v)(dr.detach(v)) for k, v in optimiser.items()}
        self._started = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Wall time of the run, excluding the time between an interruption and its resumption."""
        return time.perf_counter() - self._started

    def set_seconds(self, seconds: float) -> None:
        """Continue the clock at ``seconds``, so that evaluation in between does not count as training time."""
        self._started = time.perf_counter() - seconds

    @property
    def progress(self) -> float:
        """Completed fraction of the schedule, 0..1."""
        return self.progress_at(self.steps, self.seconds)

    def progress_at(self, steps: int, seconds: float) -> float:
        """Completed fraction of the schedule after so many ``steps`` and ``seconds``."""
        schedule, minutes = self._schedule or self.settings.steps, self.settings.minutes
        if schedule:
            return min(1.0, steps / schedule)
        since, progress = self._reserved_at
        rest = max(60 * minutes - self.reserved_seconds - since, 1e-6)
        return min(1.0, progress + (1 - progress) * (seconds - since) / rest)

    def reserve(self, seconds: float) -> None:
        """End a schedule in minutes this much earlier.

        The rest of the schedule is spread over the rest of the time, so that its progress neither jumps nor falls.
        """
        self._reserved_at, self.reserved_seconds = (self.seconds, self.progress), seconds

    @abstractmethod
    def step(self) -> None:
        """Run one optimisation step."""

    def run(self, is_done: Callable[[], bool], after_step: Callable[[], None], report: Callable[[], object]) -> bool:
        """Run steps until ``is_done``, and return whether Ctrl-C ended the run before.

        ``after_step`` evaluates and stores the run, and ``report`` may raise `KeyboardInterrupt` to end it. Ctrl-C is
        handled between two steps only, because within a step weights and random numbers are inconsistent.
        """
        with Interruption() as stop:
            while not is_done():
                self.step()
                after_step()
                try:
                    report()
                    stop.check()
                except KeyboardInterrupt:
                    return True
        return False

    def average_weights(self) -> None:
        """Update the exponential moving average of the weights."""
        # Use a short memory at first, so that the average forgets the initial weights.
        decay = min(self.settings.ema_decay, (1 + self.steps) / (10 + self.steps)) ** self.AVERAGE_INTERVAL
        # A literal would compile a new kernel in each step.
        part = dr.opaque(self.ns.Float, 1 - decay)
        for k, old in self.averaged.items():
            self.averaged[k] = type(old)(old + (dr.detach(self.optimiser[k]) - old) * part)
        dr.eval(self.averaged)

    def get_state(self) -> tuple[dict, dict]:
        """Return ``(tensors, metadata)`` for `restore`: weights, moments, averages and counters."""
        tensors, counts = {}, {}
        for name, (value, _, _, (count, first, second, _)) in self.optimiser.state.items():
            counts[name] = int(count.numpy()[0])
            parts = {"weights": value, "first": first, "second": second, "averaged": self.averaged[name]}
            tensors |= {f"{part}.{name}": x.numpy() for part, x in parts.items()}
        random = self.rng.bit_generator.state
        return tensors, {"taken": counts, "steps": self.steps, "seconds": self.seconds, "random": random} | {
            "reserved": [self.reserved_seconds, *self._reserved_at]
        }

    def restore(self, tensors: dict, meta: dict) -> None:
        """Restore the state from `get_state`. Raises ``ValueError`` or `KeyError` if it does not match."""
        counts, optimiser = meta["taken"], self.optimiser
        for name, (value, promoted, rate, (count, first, second, max_second)) in optimiser.state.items():
            old = {"weights": value, "first": first, "second": second, "averaged": self.averaged[name]}
            for part, x in old.items():
                check_shape(tensors, f"{part}.{name}", x)
            new = {part: type(x)(tensors[f"{part}.{name}"]) for part, x in old.items()}
            dr.enable_grad(new["weights"])
            count = dr.opaque(type(count), int(read_count(counts, name)))
            optimiser.state[name] = new["weights"], promoted, rate, (count, new["first"], new["second"], max_second)
            self.averaged[name] = new["averaged"]
        dr.eval(optimiser.state, self.averaged)
        self.steps = int(read_count(meta, "steps"))
        self.set_seconds(read_count(meta, "seconds"))
        self.rng.bit_generator.state = meta["random"]
        # States of earlier versions reserve no time.
        reserved = check_json(meta.get("reserved", [0.0, 0.0, 0.0]), Items(Number(0), 3, 3), "reserved")
        self.reserved_seconds, self._reserved_at = reserved[0], (reserved[1], reserved[2])


# ---- Run state in a file, from which an interrupted run continues as if it had not been interrupted ----
#
# With one thread the weights equal those of an uninterrupted run bit for bit. With more threads the order of sums
# differs between any two runs.


# Ranges of the counters of a run. Arrays count steps in 32 bits.
_COUNTS = {"rays": (0, 2**60), "samples": (0, 2**60), "looked": (0, 2**60), "stride": (1, 2**20)}


@contextmanager
def reading_run_state(path: str | Path) -> Iterator[None]:
    """Convert errors caused by a damaged run state in the block to a `NergError` that names ``path``."""
    with translate_read_errors(
        path, "run state", f"start again without {parameter('resume', True)}", extra_errors=(TypeError, AttributeError)
    ):
        yield


def read_count(meta: dict, name: str) -> float:
    """Read the number ``name`` of a run state. Raises ``ValueError`` if it is outside its range."""
    value, (minimum, maximum) = read_number(meta, name, "state"), _COUNTS.get(name, (0, 2**32 - 1))
    if not minimum <= value <= maximum:
        raise ValueError(f'"{name}" of its state is {value:g}, which is outside {minimum:g} to {maximum:g}')
    return value


def check_shape(tensors: dict, name: str, like) -> None:
    """Raise ``ValueError`` unless the stored array ``name`` has the shape of the Dr.Jit array ``like``."""
    if tuple(tensors[name].shape) != tuple(dr.shape(like)):
        raise ValueError(f'its array "{name}" has shape {tuple(tensors[name].shape)}; expected {tuple(dr.shape(like))}')


@contextmanager
def saving_on_failure(path: Path | None, save: Callable[[], None], is_done: bool) -> Iterator[None]:
    """Save the run state if the block, which evaluates and writes the result of a training, raises.

    Parameters
    ----------
    path : Path or None
        State file; None: no state is stored. It is removed after the block if ``is_done``.
    save : callable
        Updates the state file. It is called if the block raises, so that a full disk or Ctrl-C loses no step.
    is_done : bool
        Whether the state is no longer needed.

    Raises
    ------
    NergError
        The error of the block, extended by how to resume.
    """
    try:
        yield
    except BaseException as error:
        if path is None:
            raise
        try:
            save()
        except NergError:
            # Probably the same full disk: an older state remains, and the first error is the one to report.
            raise error from None
        if isinstance(error, NergError):
            reason = error.message.rstrip(".")
            raise NergError(
                f"{reason}; the training is saved: fix this and write it with {parameter('resume', True)}"
            ) from error
        if isinstance(error, KeyboardInterrupt):
            raise Interrupted(f"interrupted; resume with {parameter('resume', True)} (state in {path})") from error
        raise
    if path is not None and is_done:
        path.unlink(missing_ok=True)


# Settings in checkpoints and states of earlier versions, and their current names.
_OLD_SETTINGS = {
    "count": "probes",
    "cap": "max_rays",
    "fresh": "resample_directions",
    "weights": "ray_weights",
    "mix_kappa": "prior_kappa",
    "mix_folds": "prior_folds",
    "integral": "integral_weight",
    "zones": "validation_zones",
    "frozen": "freeze",
    "final_rate": "lr_final_ratio",
    "hold": "lr_hold_fraction",
    "average": "ema_decay",
    "looks": "num_validations",
    "watched": "validation_probes",
    "watched_rays": "validation_min_rays",
    "growth": "step_growth",
    "reach": "damping_distance",
    "reach_share": "damping_fraction",
    "stop": "min_transmittance",
    "thin_sure": "rr_weight",
    "thin_least": "rr_min_probability",
    "grid_every": "grid_interval",
    "settle": "extraction_start",
    "look_most": "max_prepass_batches",
    "stride_share": "stride_fraction",
    "huber": "huber_delta",
    "final_depth": "depth_weight_final_ratio",
    "replay": "hard_pixel_fraction",
}


def use_current_names(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``record``, the identity of a run or a provenance, with the current names of settings and probes."""
    parts = {key: record[key] for key in ("settings", "probes") if isinstance(record.get(key), dict)}
    return {**record} | {
        key: {_OLD_SETTINGS.get(name, name): value for name, value in part.items()} for key, part in parts.items()
    }


def check_same_run(path: str | Path, then: dict, now: dict) -> None:
    """Raise `NergError` unless the identities ``then`` of the stored run and ``now`` of this run agree."""
    if not isinstance(then, dict):
        raise NergError(
            f'cannot resume the run in "{path}": its state is damaged; start again without {parameter("resume", True)}'
        )
    different = list(_list_differences(use_current_names(then), json.loads(json.dumps(now))))
    if different:
        raise NergError(
            f'cannot resume the run in "{path}": it was started with different {", ".join(different)}; use the '
            f"same options and data, or start again without {parameter('resume', True)}"
        )


def _list_differences(then: dict, now: dict) -> Iterator[str]:
    """Yield the names of the values of ``now`` that ``then`` does not have, such as "settings.steps"."""
    for name, value in now.items():
        old = then.get(name)
        if isinstance(old, dict) and isinstance(value, dict):
            yield from (f"{name}.{part}" for part in _list_differences(old, value))
        elif old != value:
            yield name


# ---- Duration of the steps and rate of field evaluations ----

MAX_DURATIONS = 1 << 12  # Maximum number of stored durations, so that the state of a long run stays small


class StepClock:
    """Context manager that times each step.

    Attributes
    ----------
    evaluations : int
        Field evaluations within steps: number of positions at which the density, or density and colour, was evaluated.
    steps, seconds : int, float
        Number and total duration of all steps.
    extremes : list of float
        Shortest and longest duration in seconds.
    durations : list of float
        Duration of every ``keep_every``-th step, for the median.

    Notes
    -----
    Dr.Jit may still be computing when a step ends; the next step then waits for it.
    """

    def __init__(self):
        self.evaluations, self.steps, self.seconds, self.keep_every = 0, 0, 0.0, 1
        self.extremes, self.durations, self._running = [float("inf"), 0.0], [], False

    def __enter__(self) -> StepClock:
        self._running, self._begin = True, time.perf_counter()
        return self

    def __exit__(self, *error) -> None:
        self._running = False
        self.add_step(time.perf_counter() - self._begin)

    def add_step(self, seconds: float) -> None:
        """Record a step of this duration in seconds."""
        if self.steps % self.keep_every == 0:
            self.durations.append(seconds)
        self.steps, self.seconds = self.steps + 1, self.seconds + seconds
        self.extremes = [min(self.extremes[0], seconds), max(self.extremes[1], seconds)]
        if len(self.durations) > MAX_DURATIONS:
            self.durations, self.keep_every = self.durations[::2], 2 * self.keep_every

    def add_evaluations(self, evaluations: int) -> None:
        """Count field evaluations if a step is running. Evaluations of validations and bounds are not timed."""
        if self._running:
            self.evaluations += evaluations

    def summary(self) -> dict:
        """Return statistics of the steps so far; empty before the first step.

        ``evaluations_a_second`` is the number of positions per second at which the field was evaluated within steps.
        ``step_ms`` is a dictionary with the ``min``, ``median`` and ``max`` duration of a step in milliseconds.
        """
        if not self.steps:
            return {}
        ms = {"min": self.extremes[0], "median": np.median(self.durations), "max": self.extremes[1]}
        return {
            "evaluations_a_second": round(self.evaluations / max(self.seconds, 1e-9)),
            "step_ms": {name: round(1e3 * float(value), 1) for name, value in ms.items()},
        }

    def to_dict(self) -> dict:
        """Return the state for ``restore``."""
        return {
            "evaluations": self.evaluations,
            "steps": self.steps,
            "seconds": self.seconds,
            "each": self.keep_every,
            "extremes": self.extremes if self.steps else [],
            "durations": [round(x, 5) for x in self.durations],
        }

    def restore(self, state: dict) -> None:
        self.evaluations, self.steps, self.keep_every = (int(state[name]) for name in ("evaluations", "steps", "each"))
        self.seconds, self.durations = float(state["seconds"]), [float(x) for x in state["durations"]]
        self.extremes = [float(x) for x in state["extremes"]] or [float("inf"), 0.0]
        if self.steps < 0 or self.keep_every < 1 or len(self.extremes) != 2 or bool(self.durations) != bool(self.steps):
            raise ValueError('its "clock" is inconsistent')
