"""Compiling what a radiance training runs, before its clock starts."""

from __future__ import annotations

import copy
from contextlib import contextmanager

import drjit as dr

from nerg_mi.training.common.step_clock import StepClock


def warm_up(trainer) -> None:
    """Run, and forget, what the steps of ``trainer`` (`RadianceTrainer`) consist of.

    Compiling takes seconds where the kernels are not in Dr.Jit's cache on the disk: a large share of a run of a minute,
    in the part that decides how it ends. Weights, random numbers and all else are as they were before; the clock of the
    run starts.
    """
    with _forgotten(trainer):
        every, grid = trainer.settings.grid_every, trainer.grid
        # The kernels of the average differ the first two times; a step whose number is divisible looks over the grid.
        for before in (3, 7, every):
            trainer.steps = before
            trainer.step()
        # Nothing is empty yet, and the penalty on what is has kernels of its own, which differ where the grid has just
        # been looked over.
        for before in (every, every + 1):
            grid.value = dr.select((grid.index & 1) == 0, grid.value, 0)
            dr.eval(grid.value)
            grid.off = dr.opaque(type(grid.off), 0, 64)
            trainer.steps = before
            trainer.step()
        settling = trainer.settling
        for at in (0, 1, settling.PROBES, settling.PIECES - 1):
            # As if density had been found everywhere: where there is none yet no ray would meet any.
            settling.dense = dr.select(grid.seen, type(grid.bits)(1), 0)
            settling.at = at
            trainer.update_live()
            trainer.settle()
        dr.sync_thread()
    trainer.start()


@contextmanager
def _forgotten(trainer):
    parts = (trainer, trainer.grid, trainer.settling, trainer.optimiser)
    # Arrays are scattered to in place: a second name would change with the first.
    before = [{k: type(v)(v) if dr.is_array_v(v) else v for k, v in vars(part).items()} for part in parts]
    state, averaged, rng = dict(trainer.optimiser.state), dict(trainer.averaged), copy.deepcopy(trainer.rng)
    live = {k: type(v)(v) for k, v in trainer.live.parameters().items()}
    try:
        yield
    finally:
        for part, values in zip(parts, before):
            vars(part).update(values)
        trainer.averaged, trainer.rng, trainer.clock = averaged, rng, StepClock()
        for name, (value, *rest) in state.items():
            # The old array has gathered derivatives.
            value = type(value)(dr.detach(value))
            dr.enable_grad(value)
            state[name] = (value, *rest)
        trainer.optimiser.state = state
        trainer.live.set_parameters(live)
