"""The state of a training on disk, from which it resumes, and the clock of its steps."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.safe_read import reading
from nerg_mi.formats.checkpoint import read_checkpoint, write_checkpoint
from nerg_mi.formats.fields import number

# ---- The whole state of a training in a file, so that an interrupted run goes on as if it had not been ----
#
# With one thread the weights then equal those of a run without interruption bit for bit; with more, sums over threads
# come in no fixed order in either.


KIND = "radiance run"
# The least and the most of what a run counts; arrays count steps in 32 bits.
_COUNTS = {"rays": (0, 2**60), "samples": (0, 2**60), "looked": (0, 2**60), "stride": (1, 2**20)}
_GRID = ("value", "bits", "seen", "always")
_NUMBERS = ("steps", "rays", "samples", "stride", "looked")


def save_run(trainer, path: str | Path, about: dict, history: list) -> None:
    """Write the state of ``trainer`` (`RadianceTrainer`) atomically. ``about``: what the run must agree on to be
    resumed (JSON); ``history``: of its held-out error so far."""
    tensors, taken = optimiser_state(trainer)
    for name in _GRID:
        tensors[f"grid.{name}"] = getattr(trainer.grid, name).numpy()
    tensors["hard"] = trainer.hard
    settling = trainer.settling
    tensors |= {"settling.found": settling.found.numpy(), "settling.shown": settling.shown.numpy()}
    metadata = {
        "about": about,
        "history": history,
        "taken": taken,
        **{name: getattr(trainer, name) for name in _NUMBERS},
        "seconds": trainer.seconds,
        "settling": settling.at,
        "turn": trainer.grid.turn,
        "clock": trainer.clock.to_dict(),
        "random": trainer.rng.bit_generator.state,
    }
    write_checkpoint(path, KIND, tensors, metadata)


def load_run(trainer, path: str | Path, about: dict) -> list:
    """Set ``trainer`` to the state in ``path``; returns the history.

    Raises `NergError` unless the state is one of a run with the same ``about``.
    """
    tensors, meta = read_checkpoint(path, KIND)
    with restoring(path):
        require_same(path, meta["about"], about)
        counts = {name: count_of(meta, name) for name in (*_NUMBERS, "seconds")}
        for name in _GRID:
            require_shape(tensors, f"grid.{name}", getattr(trainer.grid, name))
        for name in ("found", "shown"):
            require_shape(tensors, f"settling.{name}", getattr(trainer.settling, name))
        restore_optimiser(trainer, tensors, meta["taken"])
        trainer.grid.restore(*[tensors[f"grid.{name}"] for name in _GRID], int(count_of(meta, "turn")))
        trainer.rng.bit_generator.state = meta["random"]
        trainer.settling.restore(
            int(number(meta, "settling", "state")), tensors["settling.found"], tensors["settling.shown"]
        )
        trainer.clock.restore(meta["clock"])
        trainer.restore(hard=tensors["hard"], **counts)
        return list(meta["history"])


@contextmanager
def restoring(path: str | Path) -> Iterator[None]:
    """What a damaged state makes the block raise, as a `NergError` that names ``path``."""
    with reading(path, "state of a run", "start anew without --resume", also=(TypeError, AttributeError)):
        yield


def count_of(meta: dict, name: str) -> float:
    """The number ``name`` of a state's metadata. Raises ``ValueError`` where it is none that a run can have come to."""
    value, (least, most) = number(meta, name, "state"), _COUNTS.get(name, (0, 2**32 - 1))
    if not least <= value <= most:
        raise ValueError(f'"{name}" of its state is {value:g}, which no run comes to')
    return value


def require_shape(tensors: dict, name: str, like) -> None:
    """Raise ``ValueError`` unless the stored array ``name`` has the shape of the Dr.Jit array ``like``."""
    if tuple(tensors[name].shape) != tuple(dr.shape(like)):
        raise ValueError(f'its array "{name}" has the shape {tensors[name].shape} and not {tuple(dr.shape(like))}')


@contextmanager
def kept_unless(path: Path | None, keep: Callable[[], None], done: bool) -> Iterator[None]:
    """A block that measures and writes what a training has come to; only when it has ended is the state in ``path``
    removed.

    ``path``: None where no state is kept; ``keep``: brings it up to date, called if the block raises, so that no step
    is lost to a full disk or to Ctrl-C; ``done``: whether the state goes. A `NergError` of the block then says how to
    go on.
    """
    try:
        yield
    except BaseException as error:
        if path is None:
            raise
        try:
            keep()
        except NergError:
            # The same full disk: an older state stays, and what could not be written first is what is told.
            raise error from None
        if isinstance(error, NergError):
            reason = str(error).rstrip(".")
            raise NergError(f"{reason}; the training is kept: once that is mended, --resume writes it") from error
        if isinstance(error, KeyboardInterrupt):
            raise KeyboardInterrupt(f"interrupted; go on with --resume (state in {path})") from error
        raise
    if path is not None and done:
        path.unlink(missing_ok=True)


def optimiser_state(trainer) -> tuple[dict, dict]:
    """``(tensors, taken)``: weights, moments and averages of ``trainer`` by name, and the steps that each array has
    taken.

    ``trainer``: has an ``optimiser`` (Adam or AdamW) and the dictionary ``averaged`` of its weights.
    """
    tensors, taken = {}, {}
    for name, (value, _, _, (count, first, second, _)) in trainer.optimiser.state.items():
        taken[name] = int(count.numpy()[0])
        parts = {"weights": value, "first": first, "second": second, "averaged": trainer.averaged[name]}
        tensors |= {f"{part}.{name}": x.numpy() for part, x in parts.items()}
    return tensors, taken


def restore_optimiser(trainer, tensors: dict, taken: dict) -> None:
    """Set ``trainer`` to what ``optimiser_state`` gave. Raises ``ValueError`` or `KeyError` where that does not fit
    it."""
    optimiser = trainer.optimiser
    for name, (value, promoted, rate, (count, first, second, largest)) in optimiser.state.items():
        old = {"weights": value, "first": first, "second": second, "averaged": trainer.averaged[name]}
        for part, x in old.items():
            require_shape(tensors, f"{part}.{name}", x)
        new = {part: type(x)(tensors[f"{part}.{name}"]) for part, x in old.items()}
        dr.enable_grad(new["weights"])
        count = dr.opaque(type(count), int(count_of(taken, name)))
        optimiser.state[name] = new["weights"], promoted, rate, (count, new["first"], new["second"], largest)
        trainer.averaged[name] = new["averaged"]
    dr.eval(optimiser.state, trainer.averaged)


def require_same(path: str | Path, then: dict, now: dict) -> None:
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
