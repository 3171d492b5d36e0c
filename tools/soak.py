"""Long use: memory stays flat over thousands of frames and training steps, changes of variant, and with two threads.

    python -m tools.soak [--part NAME ...] [--share 1.0] [--update docs/trust.md]

Each part runs in a process of its own. Its resident memory is sampled between units of work, the first third is let
pass (kernels are compiled and caches filled), and a line is fitted to the rest by least squares. A part fails, and the
exit code is 1, where the line climbs by more than the part's bound. ``--share`` shortens every part.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

import nerg_mi  # noqa: F401 (before Mitsuba, since it chooses the libLLVM)
from tools import tiny
from tools.page import table, update

ROOT = Path(__file__).resolve().parents[1]

_SAMPLES = 120
_SIZES = {"width": "36", "height": "24"}


@dataclass(frozen=True)
class Course:
    """What became of a part: ``count`` units of work (``unit``), resident memory in MiB when the line begins and at the
    end, its ``slope`` and the ``bound`` on it in KiB a unit."""

    unit: str
    count: int
    begin: float
    end: float
    slope: float
    bound: float

    @property
    def flat(self) -> bool:
        return self.slope <= self.bound

    def cells(self, name: str) -> list[str]:
        numbers = f"{self.begin:.0f} MiB", f"{self.end:.0f} MiB", f"{self.slope:+.3f} KiB", f"{self.bound:g} KiB"
        return [name, f"{self.count:,} {self.unit}", *numbers, "flat" if self.flat else "grows"]


HEAD = ("What", "Units", "After the warm-up", "At the end", "Slope a unit", "Bound a unit", "Result")


def resident() -> float:
    """Memory of this process that is in RAM, in KiB, once what nothing refers to any more has gone back to the
    system."""
    import drjit as dr

    gc.collect()
    dr.flush_malloc_cache()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1024


def watch(unit: Callable[[int], object], count: int, bound: float, name: str = "units") -> Course:
    """Do ``unit(k)`` for k in 0 .. ``count``, sampling memory in between, and fit a line to what follows the first
    third."""
    every = max(1, count // _SAMPLES)
    at, memory = [], []
    for k in range(count):
        unit(k)
        if (k + 1) % every == 0:
            at.append(k + 1)
            # A thread that is about to end may still hold memory that nothing refers to.
            memory.append(min(resident() for _ in range(3)))
    warm = len(at) // 3
    slope, start = np.polyfit(at[warm:], memory[warm:], 1)
    line = start + slope * np.array([at[warm], at[-1]])
    return Course(name, count, line[0] / 1024, line[1] / 1024, float(slope), bound)


# ----------------------------------------------------------------------------
# Parts: each prepares, and gives what one unit of work is
# ----------------------------------------------------------------------------


def _variant(name: str = "llvm_ad_rgb"):
    import mitsuba as mi

    mi.set_variant(name)
    return mi


def _store(mi, **values: str):
    from nerg_mi.jobs.demo import store_scene

    return mi.load_file(str(store_scene()), **(_SIZES | values))


def _eye(mi, k: int):
    """Where the observer stands in the store at frame ``k``: up and down an aisle."""
    return mi.ScalarTransform4f().look_at(
        [4.4 + 0.3 * np.sin(0.1 * k), 2.8 + 0.5 * np.cos(0.07 * k), 1.6], [4.8, 4.4, 1.2], [0, 0, 1]
    )


def frames() -> Callable[[int], None]:
    """A frame of the store for an observer who moves on."""
    mi = _variant()
    scene = _store(mi)
    params = mi.traverse(scene)
    key = "integrator.observer.to_world"

    def frame(k: int) -> None:
        params[key] = _eye(mi, k)
        params.update()
        assert np.isfinite(np.array(mi.render(scene, spp=1, seed=k))).all()

    return frame


def radiance_steps() -> Callable[[int], None]:
    """A step of a tiny radiance training."""
    mi = _variant()
    import drjit as dr
    import drjit.llvm.ad as ns

    from nerg_mi.capture.cameras import Camera
    from nerg_mi.capture.images import View
    from nerg_mi.capture.intrinsics import Intrinsics
    from nerg_mi.field.encoding.hashgrid import HashGridConfig
    from nerg_mi.field.radiance import RadianceConfig
    from nerg_mi.maths.box import Box
    from nerg_mi.training.radiance.settings import RadianceSettings
    from nerg_mi.training.radiance.trainer import RadianceTrainer

    assert mi.variant()
    lens = Intrinsics(tiny.SIDE, tiny.SIDE, 30.0, 30.0, tiny.SIDE / 2, tiny.SIDE / 2)
    rng, views = np.random.default_rng(0), []
    for k in range(12):
        center = rng.normal(size=3) * [1, 1, 0.5]
        pose = tiny.ball_pose(2 * center / np.linalg.norm(center))
        views.append(View(str(k), Camera(lens, pose), tiny.ball_photo(pose).astype(np.float32)))
    config = RadianceConfig(grid=HashGridConfig(levels=2, log2_rows=10, base=4, finest=16), width=16, color_hidden=1)
    settings = RadianceSettings(steps=20_000, batch=2**10, resolution=16, march_step=1 / 32)
    trainer = RadianceTrainer(views, Box(*tiny.CORNERS), config, settings, ns)

    def step(k: int) -> None:
        trainer.step()
        # Whoever trains looks at the loss now and then; steps that nobody waits for would only queue up.
        dr.eval(trainer.loss)
        dr.sync_thread()

    return step


def gaze_steps() -> Callable[[int], None]:
    """A step of a tiny gaze training."""
    _variant()
    import drjit as dr
    import drjit.llvm.ad as ns

    from nerg_mi.field.encoding.hashgrid import HashGridConfig
    from nerg_mi.field.gaze.product import GazeConfig
    from nerg_mi.training.gaze.product import ProductTrainer
    from nerg_mi.training.gaze.ray_targets import targets_of_rays
    from nerg_mi.training.gaze.settings import GazeSettings, ProbeSettings
    from nerg_mi.training.geometry.places import place_of_nothing

    rays = tiny.looks()
    place = place_of_nothing(rays.origin)
    probes = ProbeSettings(radius=0.5, count=16, cap=64, min_rays=8, kappa=20.0, directions=64)
    config = GazeConfig(grid=HashGridConfig(levels=2, log2_rows=10, base=4, finest=8), width=16, geometry=4)
    targets = targets_of_rays(rays, place, probes)
    settings = GazeSettings(steps=20_000, probes=4, directions=32, zones=0)
    trainer = ProductTrainer(targets, place.box, config, settings, ns)

    def step(k: int) -> None:
        trainer.step()
        dr.sync_thread()

    return step


def variants() -> Callable[[int], None]:
    """A change of variant, after which the store is loaded and rendered."""
    mi = _variant("llvm_ad_mono")

    def change(k: int) -> None:
        mi.set_variant(("llvm_ad_rgb", "llvm_ad_mono")[k % 2])
        assert np.isfinite(np.array(mi.render(_store(mi, width="12", height="8"), spp=1))).all()

    return change


def threads() -> Callable[[int], None]:
    """A frame of each of two scenes, rendered at the same time by two threads; pictures must be those of one thread
    alone."""
    mi = _variant()
    scenes = _store(mi), _store(mi, eye="6.3, 3.0, 1.6")
    alone = [np.array(mi.render(scene, spp=1, seed=1)) for scene in scenes]
    assert not np.array_equal(*alone)

    def frame(k: int) -> None:
        seen: list = [None, None]

        def work(which: int) -> None:
            seen[which] = np.array(mi.render(scenes[which], spp=1, seed=1))

        workers = [threading.Thread(target=work, args=(which,)) for which in range(2)]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
        for which in range(2):
            assert seen[which] is not None and np.array_equal(seen[which], alone[which]), (
                f"frame {k} of scene {which} differs"
            )

    return frame


@dataclass(frozen=True)
class Part:
    """``prepare`` gives the unit of work, of which there are ``count``; ``bound``: KiB that memory may grow a unit."""

    prepare: Callable[[], Callable[[int], None]]
    unit: str
    count: int
    bound: float


PARTS = {
    "moving observer": Part(frames, "frames", 2_000, 1.0),
    "radiance training": Part(radiance_steps, "steps", 10_000, 0.5),
    "gaze training": Part(gaze_steps, "steps", 10_000, 0.2),
    "changes of variant": Part(variants, "changes", 50, 200.0),
    "two threads, two scenes": Part(threads, "pairs of frames", 500, 4.0),
}


def run_part(name: str, share: float = 1.0) -> Course:
    """The part called ``name``, in this process."""
    part = PARTS[name]
    return watch(part.prepare(), max(12, round(share * part.count)), part.bound, part.unit)


def run_apart(name: str, share: float) -> Course | str:
    """The part called ``name`` in a process of its own; what went wrong where it did not come to its end."""
    command = [sys.executable, "-m", "tools.soak", "--only", name, "--share", str(share)]
    done = subprocess.run(command, cwd=ROOT, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    if done.returncode != 0:
        return f"ended with {done.returncode}: {(done.stderr.strip().splitlines() or ['nothing said'])[-1]}"
    # Mitsuba's log may stand before it on the same line.
    last = done.stdout.splitlines()[-1]
    return Course(**json.loads(last[last.index("{") :]))


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--part", action="append", choices=PARTS)
    parser.add_argument("--share", type=float, default=1.0, help="share of the units to do")
    parser.add_argument("--update", type=Path, help="page whose table is exchanged")
    parser.add_argument("--only", choices=PARTS, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.only:
        print(json.dumps(asdict(run_part(options.only, options.share))))
        return 0

    rows, good = [], True
    for name in options.part or PARTS:
        course = run_apart(name, options.share)
        failed = isinstance(course, str)
        rows.append([name, *[""] * 5, course] if failed else course.cells(name))
        good &= not failed and course.flat
        print(" | ".join(rows[-1]), file=sys.stderr, flush=True)
    update(options.update, "Soak", table(HEAD, rows))
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
