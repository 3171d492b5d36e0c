"""What trainings of radiance and of gaze share: length, learning rate, averaged weights, the state on disk from which
they resume, and the clock of their steps."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.safe_read import translate_read_errors
from nerg_mi.formats.fields import read_number

# ---- Trainer ----


class Trainer:
    """Base of one run: an optimiser, the moving averages of its weights, which are the result, and the clock.

    ``schedule``: steps that the learning rate's schedule spans, where that is not ``settings``' own length.
    """

    AVERAGE_INTERVAL: ClassVar[int] = 1  # The average is taken of every so many steps

    def __init__(self, settings: Any, ns: ModuleType, schedule: int | None = None):
        self.settings, self.ns, self._schedule = settings, ns, schedule
        self.rng = np.random.default_rng(settings.seed)
        self.steps = 0
        self.optimiser: Any = None
        self.averaged: dict[str, Any] = {}

    def start(self, optimiser: Any = None) -> None:
        """Start the clock of the run; with an ``optimiser`` (Adam or AdamW), of whose weights."""
        if optimiser is not None:
            self.optimiser = optimiser
            self.averaged = {k: type(v)(dr.detach(v)) for k, v in optimiser.items()}
        self._started = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Wall time of the run, without that between an interruption and its resumption."""
        return time.perf_counter() - self._started

    @property
    def progress(self) -> float:
        """Share of the schedule that is done, 0..1."""
        steps, minutes = self._schedule or self.settings.steps, self.settings.minutes
        return min(1.0, self.steps / steps if steps else self.seconds / (60 * minutes))

    def move_weights(self) -> None:
        """Move the weights along the gradients that are in them."""
        self.optimiser.set_learning_rate(self.settings.learning_rate_at(self.progress))
        self.optimiser.step()

    def average_weights(self) -> None:
        """Move the averages towards the weights of this step."""
        # A short memory at first: the start of a run is not worth remembering.
        decay = min(self.settings.ema_decay, (1 + self.steps) / (10 + self.steps)) ** self.AVERAGE_INTERVAL
        # As a literal it would compile a kernel each time.
        part = dr.opaque(self.ns.Float, 1 - decay)
        for k, old in self.averaged.items():
            self.averaged[k] = type(old)(old + (dr.detach(self.optimiser[k]) - old) * part)
        dr.eval(self.averaged)

    def get_state(self) -> tuple[dict, dict]:
        """``(tensors, metadata)`` for `restore`: weights, moments and averages by name, and all that a run counts."""
        tensors, taken = {}, {}
        for name, (value, _, _, (count, first, second, _)) in self.optimiser.state.items():
            taken[name] = int(count.numpy()[0])
            parts = {"weights": value, "first": first, "second": second, "averaged": self.averaged[name]}
            tensors |= {f"{part}.{name}": x.numpy() for part, x in parts.items()}
        random = self.rng.bit_generator.state
        return tensors, {"taken": taken, "steps": self.steps, "seconds": self.seconds, "random": random}

    def restore(self, tensors: dict, meta: dict) -> None:
        """Go on from what `state` gave. Raises ``ValueError`` or `KeyError` where that does not fit."""
        taken, optimiser = meta["taken"], self.optimiser
        for name, (value, promoted, rate, (count, first, second, largest)) in optimiser.state.items():
            old = {"weights": value, "first": first, "second": second, "averaged": self.averaged[name]}
            for part, x in old.items():
                check_shape(tensors, f"{part}.{name}", x)
            new = {part: type(x)(tensors[f"{part}.{name}"]) for part, x in old.items()}
            dr.enable_grad(new["weights"])
            count = dr.opaque(type(count), int(read_count(taken, name)))
            optimiser.state[name] = new["weights"], promoted, rate, (count, new["first"], new["second"], largest)
            self.averaged[name] = new["averaged"]
        dr.eval(optimiser.state, self.averaged)
        self.steps = int(read_count(meta, "steps"))
        self._started = time.perf_counter() - read_count(meta, "seconds")
        self.rng.bit_generator.state = meta["random"]


# ---- The state of a training in a file, so that an interrupted run goes on as if it had not been ----
#
# With one thread the weights then equal those of a run without interruption bit for bit; with more, sums over threads
# come in no fixed order in either.


# The least and the most of what a run counts; arrays count steps in 32 bits.
_COUNTS = {"rays": (0, 2**60), "samples": (0, 2**60), "looked": (0, 2**60), "stride": (1, 2**20)}


@contextmanager
def reading_run_state(path: str | Path) -> Iterator[None]:
    """What a damaged state makes the block raise, as a `NergError` that names ``path``."""
    with translate_read_errors(path, "state of a run", "start anew without --resume", extra_errors=(TypeError, AttributeError)):
        yield


def read_count(meta: dict, name: str) -> float:
    """The number ``name`` of a state's metadata. Raises ``ValueError`` where it is none that a run can have come to."""
    value, (least, most) = read_number(meta, name, "state"), _COUNTS.get(name, (0, 2**32 - 1))
    if not least <= value <= most:
        raise ValueError(f'"{name}" of its state is {value:g}, which no run comes to')
    return value


def check_shape(tensors: dict, name: str, like) -> None:
    """Raise ``ValueError`` unless the stored array ``name`` has the shape of the Dr.Jit array ``like``."""
    if tuple(tensors[name].shape) != tuple(dr.shape(like)):
        raise ValueError(f'its array "{name}" has the shape {tensors[name].shape} and not {tuple(dr.shape(like))}')


@contextmanager
def saving_on_failure(path: Path | None, save: Callable[[], None], is_done: bool) -> Iterator[None]:
    """A block that measures and writes what a training has come to; the state in ``path`` is removed when it has ended.

    ``path``: None where no state is kept; ``keep``: brings it up to date, called if the block raises, so that no step
    is lost to a full disk or to Ctrl-C; ``done``: whether the state goes. A `NergError` then says how to go on.
    """
    try:
        yield
    except BaseException as error:
        if path is None:
            raise
        try:
            save()
        except NergError:
            # The same full disk: an older state stays, and what could not be written first is what is told.
            raise error from None
        if isinstance(error, NergError):
            reason = str(error).rstrip(".")
            raise NergError(f"{reason}; the training is kept: once that is mended, --resume writes it") from error
        if isinstance(error, KeyboardInterrupt):
            raise KeyboardInterrupt(f"interrupted; go on with --resume (state in {path})") from error
        raise
    if path is not None and is_done:
        path.unlink(missing_ok=True)


def check_same_run(path: str | Path, then: dict, now: dict) -> None:
    """Raise `NergError` unless a run that was started as ``then`` says is the one that ``now`` says, entry by entry."""
    if not isinstance(then, dict):
        raise NergError(f'the run in "{path}" cannot go on: its state is damaged; start anew without --resume')
    now = json.loads(json.dumps(now))
    different = [k for k in now if then.get(k) != now[k]]
    if different:
        raise NergError(
            f'the run in "{path}" cannot go on: it was started with other {", ".join(different)}; give the options and '
            "the data set that it was started with, or start anew without --resume"
        )


# ---- How long the steps of a training take, and how fast the machine evaluates the field in them ----

MAX_DURATIONS = 1 << 12  # Durations that are kept at most: the state of a run of days must stay small enough to be read again


class StepClock:
    """A context around each step. ``evaluations``: of the field, in steps; ``steps`` and ``seconds``: of all of them;
    ``extremes``: the shortest and the longest, in seconds; ``durations``: of every ``each``-th, for the median.

    Dr.Jit may still be computing when a step ends; the next one then waits for it.
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
        """One more step, of so many ``seconds``."""
        if self.steps % self.keep_every == 0:
            self.durations.append(seconds)
        self.steps, self.seconds = self.steps + 1, self.seconds + seconds
        self.extremes = [min(self.extremes[0], seconds), max(self.extremes[1], seconds)]
        if len(self.durations) > MAX_DURATIONS:
            self.durations, self.keep_every = self.durations[::2], 2 * self.keep_every

    def add_evaluations(self, evaluations: int) -> None:
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
            "each": self.keep_every,
            "extremes": self.extremes if self.steps else [],
            "durations": [round(x, 5) for x in self.durations],
        }

    def restore(self, state: dict) -> None:
        self.evaluations, self.steps, self.keep_every = (int(state[name]) for name in ("evaluations", "steps", "each"))
        self.seconds, self.durations = float(state["seconds"]), [float(x) for x in state["durations"]]
        self.extremes = [float(x) for x in state["extremes"]] or [float("inf"), 0.0]
        if self.steps < 0 or self.keep_every < 1 or len(self.extremes) != 2 or bool(self.durations) != bool(self.steps):
            raise ValueError('its "clock" is not one of a run')
