"""Long use: memory stays flat over frames, training steps and changes of variant.

`make soak` runs thousands of units of work; without NERG_SOAK=1 a thirtieth of them is done. A line is fitted to the
resident memory between units after the first third, in which kernels are compiled and caches filled.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import nerg_mi  # noqa: F401 (before Mitsuba, since it chooses the libLLVM)
from tests import tiny
from tests.conftest import ROOT

SHORT = 1 if os.environ.get("NERG_SOAK") else 30


def resident() -> float:
    """Return the resident memory of this process in KiB after unused memory has been released."""
    import drjit as dr

    gc.collect()
    dr.flush_malloc_cache()
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
        trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1024


def record_memory(unit: Callable[[int], object], count: int) -> tuple[list[int], list[float]]:
    """Return numbers of units of work ``unit(k)``, for k from 0 to ``count``, and the memory in KiB after each, without
    a first third that warms up."""
    every = max(1, count // 120)
    at, memory = [], []
    for k in range(count):
        unit(k)
        if (k + 1) % every == 0:
            at.append(k + 1)
            # A finishing thread can still hold memory.
            memory.append(min(resident() for _ in range(3)))
    warm = len(at) // 3
    return at[warm:], memory[warm:]


def slope(unit: Callable[[int], object], count: int) -> float:
    """Return the growth of the memory in KiB per unit of work."""
    return float(np.polyfit(*record_memory(unit, count), 1)[0])


def usual_growth(unit: Callable[[int], object], count: int) -> float:
    """Return the median growth of the memory in KiB per unit of work, without single larger allocations."""
    at, memory = record_memory(unit, count)
    return float(np.median(np.diff(memory) / np.diff(at)))


def store(**values: str):
    import mitsuba as mi
    from nerg_mi.scenes.store import SCENE_FILE

    return mi.load_file(str(SCENE_FILE), **({"width": "36", "height": "24"} | values))


def frames() -> Callable[[int], None]:
    """Render a frame of the store for an observer who walks along an aisle."""
    import mitsuba as mi

    scene = store()
    params = mi.traverse(scene)

    def frame(k: int) -> None:
        eye = [4.4 + 0.3 * np.sin(0.1 * k), 2.8 + 0.5 * np.cos(0.07 * k), 1.6]
        pose = mi.ScalarTransform4f().look_at(eye, [4.8, 4.4, 1.2], [0, 0, 1])
        params["integrator.observer.to_world"] = pose
        params.update()
        assert np.isfinite(np.array(mi.render(scene, spp=1, seed=k))).all()

    return frame


def radiance_steps() -> Callable[[int], None]:
    """One step of a tiny radiance training."""
    import drjit as dr
    import drjit.llvm.ad as ns

    from nerg_mi.fields.encoding import HashGridConfig
    from nerg_mi.fields.radiance import RadianceConfig
    from nerg_mi.maths.geometry import Box
    from nerg_mi.photos.cameras import Intrinsics, PosedCamera
    from nerg_mi.photos.images import PhotoView
    from nerg_mi.train.radiance_settings import RadianceSettings
    from nerg_mi.train.radiance_trainer import RadianceTrainer

    lens = Intrinsics(tiny.SIDE, tiny.SIDE, 30.0, 30.0, tiny.SIDE / 2, tiny.SIDE / 2)
    rng, views = np.random.default_rng(0), []
    for k in range(12):
        center = rng.normal(size=3) * [1, 1, 0.5]
        pose = tiny.ball_pose(2 * center / np.linalg.norm(center))
        views.append(PhotoView(str(k), PosedCamera(lens, pose), tiny.ball_photo(pose).astype(np.float32)))
    config = RadianceConfig(grid=HashGridConfig(levels=2, log2_rows=10, base=4, finest=16), width=16, color_hidden=1)
    settings = RadianceSettings(steps=20_000, batch=2**10, resolution=16, march_step=1 / 32)
    trainer = RadianceTrainer(views, Box(*tiny.CORNERS), config, settings, ns)

    def step(k: int) -> None:
        trainer.step()
        # Read the loss regularly, as in a training; otherwise steps would queue up.
        dr.eval(trainer.loss)
        dr.sync_thread()

    return step


def gaze_steps() -> Callable[[int], None]:
    """One step of a tiny gaze training."""
    import drjit as dr
    import drjit.llvm.ad as ns

    from nerg_mi.environment.environment import no_geometry
    from nerg_mi.fields.encoding import HashGridConfig
    from nerg_mi.fields.gaze_product import GazeConfig
    from nerg_mi.train.gaze_data import make_targets_from_rays
    from nerg_mi.train.gaze_product import ProductTrainer
    from nerg_mi.train.gaze_settings import GazeSettings, ProbeSettings

    rays = tiny.simulate_gaze()
    place = no_geometry(rays.origin)
    probes = ProbeSettings(radius=0.5, probes=16, max_rays=64, min_rays=8, kappa=20.0, directions=64)
    config = GazeConfig(grid=HashGridConfig(levels=2, log2_rows=10, base=4, finest=8), width=16, geometry=4)
    settings = GazeSettings(steps=20_000, probes=4, directions=32, validation_zones=0)
    trainer = ProductTrainer(make_targets_from_rays(rays, place, probes), place.box, config, settings, ns)

    def step(k: int) -> None:
        trainer.step()
        dr.sync_thread()

    return step


def variants() -> Callable[[int], None]:
    """Change the variant, then load and render the store."""
    import mitsuba as mi

    def change(k: int) -> None:
        mi.set_variant(("llvm_ad_mono", "llvm_ad_rgb")[k % 2])
        assert np.isfinite(np.array(mi.render(store(width="12", height="8"), spp=1))).all()

    return change


PARTS = {"frames": frames, "radiance": radiance_steps, "gaze": gaze_steps, "variants": variants}

# In a separate process, because this one contains the memory of previous tests.
_PROGRAM = """
import json, sys
import nerg_mi, mitsuba
from tests import test_soak
mitsuba.set_variant("llvm_ad_rgb")
unit, hoard = test_soak.PARTS[sys.argv[1]](), []
count, bound = int(sys.argv[2]), float(sys.argv[3])
def leaking(k):
    unit(k)
    hoard.append(b"x" * round(4 * 1024 * bound))
print("\\n" + json.dumps([test_soak.slope(unit, count), test_soak.usual_growth(leaking, 12)]))
"""


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize(
    "part, count, bound",
    [("frames", 2000, 1.0), ("radiance", 10_000, 0.5), ("gaze", 10_000, 0.2), ("variants", 60, 200.0)],
)
def test_memory_is_flat_and_leaks_are_detected(part, count, bound):
    """``count`` units of work stay below ``bound`` (KiB per unit), and a leak of four times that exceeds it."""
    count, bound = max(30, count // SHORT), bound * (1 if SHORT == 1 else 100 if bound < 100 else 10)
    command = [sys.executable, "-c", _PROGRAM, part, str(count), str(bound)]
    done = subprocess.run(command, cwd=ROOT, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    sound, leaking = json.loads(done.stdout.splitlines()[-1])
    print(f"{part}: {count} units, {sound:+.3f} KiB a unit (bound {bound:g})")
    assert sound < bound and (SHORT == 1 or leaking == pytest.approx(4 * bound, rel=0.5))
