"""Shared fixtures: Mitsuba variants, memory between files, optional torch, and recorded data."""

from __future__ import annotations

import gc
import importlib.util
import json
import os
import signal
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from nerg_mi.threads import set_thread_count
from tools import other_processor

ROOT = Path(__file__).resolve().parents[1]
TORCH_REQUIRED = os.environ.get("NERG_REQUIRE_TORCH", "0") not in ("", "0")


# ------------------------------------------------------------------------
#  Variants
# ------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def rgb():
    """Activate llvm_ad_rgb before every test and return the module `mitsuba`."""
    import mitsuba as mi

    if mi.variant() != "llvm_ad_rgb":
        mi.set_variant("llvm_ad_rgb")
    return mi


@pytest.fixture(autouse=True)
def _collect_objects():
    """Free the objects of each test, whatever their references.

    Dr.Jit traces the methods of all objects of a kind, also of those that only the traceback of an expected error still
    refers to: with them, kernels differ, or fail.
    """
    yield
    gc.collect()


@pytest.fixture(autouse=True, scope="module")
def _freeze_modules():
    """Exempt what exists before a file, above all modules, from the search of `_collect_objects`."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def _restore_thread_count(rgb):
    """Restore the number of threads, which a command with ``--threads`` changes for the whole process."""
    import drjit as dr

    before = dr.thread_count()
    yield
    set_thread_count(before)


@pytest.fixture(autouse=True, scope="session")
def _keep_priority():
    """Ignore `nerg view`, which lowers the priority of its process: all later tests would run with it."""
    with pytest.MonkeyPatch.context() as change:
        change.setattr(os, "nice", lambda increment: 0, raising=False)
        yield


@pytest.fixture
def equal_processes():
    """Skip a test that compares bits with workers of a cluster, which `make portable` does not limit."""
    if os.environ.get(other_processor.VARIABLE):
        pytest.skip("workers compute as this processor, and the test as another one")


@pytest.fixture
def one_thread():
    """Use one thread, so that sums have a fixed order and equal runs are equal bit for bit."""
    set_thread_count(1)


@pytest.fixture
def mono(rgb):
    """Run the test in llvm_ad_mono; return the module `mitsuba`."""
    rgb.set_variant("llvm_ad_mono")
    yield rgb
    rgb.set_variant("llvm_ad_rgb")


@pytest.fixture(params=["llvm_ad_rgb", "llvm_ad_mono"])
def rgb_and_mono(request, rgb):
    """Run the test in llvm_ad_rgb and in llvm_ad_mono; return the module `mitsuba`."""
    rgb.set_variant(request.param)
    yield rgb
    rgb.set_variant("llvm_ad_rgb")


def _resident() -> float:
    """Return the memory of this process in GiB; infinite if the system does not report it."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return float("inf")
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**30


# Memory after the last clean-up, in GiB.
_freed = 1.0


@pytest.fixture(autouse=True, scope="module")
def _free_memory():
    """Release kernels and arrays if the process has grown by 0.5 GiB since the last clean-up.

    The suite must fit on a small machine; a clean-up after every file would take a fifth of its time.
    """
    global _freed  # noqa: PLW0603
    yield
    if _resident() < _freed + 0.5:
        return
    import drjit as dr

    gc.collect()
    dr.kernel_history_clear()
    dr.flush_malloc_cache()
    dr.flush_kernel_cache()
    _freed = max(1.0, _resident())


# ------------------------------------------------------------------------
#  Slow tests: those of slow.txt are marked here, so that the list can be generated from measured times
# ------------------------------------------------------------------------


def listed_as_slow() -> set[str]:
    """Return the entries of slow.txt: ``file::function``, or ``file`` for all tests of a file."""
    lines = (ROOT / "tests" / "slow.txt").read_text(encoding="utf-8").splitlines()
    return {line for line in lines if line and not line.startswith("#")}


def pytest_collection_modifyitems(items):
    slow, weight = listed_as_slow(), Counter()
    for item in items:
        file = item.nodeid.partition("::")[0]
        if file in slow or item.nodeid.partition("[")[0] in slow:
            item.add_marker(pytest.mark.slow)
        if "recorded" in item.fixturenames:  # large files, which are not available everywhere
            item.add_marker(pytest.mark.nightly)
        weight[file] += item.get_closest_marker("slow") is not None
    # Files with many slow tests first, so that several processes finish at the same time.
    items.sort(key=lambda item: -weight[item.nodeid.partition("::")[0]])


# ------------------------------------------------------------------------
#  Temporary files: in memory if there is space, since tests synchronise thousands of files to disk
# ------------------------------------------------------------------------


def _use_memory_for_files(config) -> None:
    memory = Path("/dev/shm")
    if config.option.basetemp is not None or not os.access(memory, os.W_OK):
        return
    free = os.statvfs(memory)
    if free.f_bavail * free.f_frsize > 4 * 2**30:
        os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(memory))


# ------------------------------------------------------------------------
#  torch is optional. With NERG_REQUIRE_TORCH=1, a test that is skipped because of it fails
# ------------------------------------------------------------------------


def pytest_configure(config):
    _use_memory_for_files(config)
    # In the background of a script, SIGINT is ignored, and child processes would inherit that.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if TORCH_REQUIRED and importlib.util.find_spec("torch") is None:
        pytest.exit(
            "NERG_REQUIRE_TORCH is set and torch is not installed: pip install torch, or unset it.", returncode=1
        )


def pytest_sessionstart():
    """Compute as the processor that `make portable` requests; processes of which a test compares bits call this."""
    if width := os.environ.get(other_processor.VARIABLE):
        other_processor.limit_drjit(int(width))


def _fail_if_skipped_for_torch(report):
    if (
        TORCH_REQUIRED
        and report.skipped
        and isinstance(report.longrepr, tuple)
        and "torch" in report.longrepr[2].lower()
    ):
        report.outcome = "failed"
        report.longrepr = f"NERG_REQUIRE_TORCH is set, and this was skipped: {report.longrepr[2]}"
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    return _fail_if_skipped_for_torch((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    return _fail_if_skipped_for_torch((yield))


@pytest.fixture
def torch():
    """Return the module `torch`; without it, the test is skipped, or fails if NERG_REQUIRE_TORCH is set."""
    return pytest.importorskip("torch", reason="torch is not installed (pip install torch)")


# ------------------------------------------------------------------------
#  Trained and random fields, made once per process; tests copy them if they write next to them
# ------------------------------------------------------------------------


@pytest.fixture(scope="session")
def standins(tmp_path_factory):
    """Return values for the defaults of the store's scene that replace its fields by random ones."""
    import mitsuba as mi

    from tests.figures.standins import write_standins

    mi.set_variant("llvm_ad_rgb")
    return write_standins(tmp_path_factory.mktemp("standins"))


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """Return a folder with ``rays.npz`` of four named participants and a ``gaze.safetensors`` trained on it.

    The geometry are the hit points; three positions are held out.
    """
    from dataclasses import replace

    import mitsuba as mi

    from nerg_mi.train.gaze import train_gaze
    from tests.evaluation.test_gaze import crowd

    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("trained")
    replace(crowd(1500), persons=("Ada", "Grace", "Mary", "Edsger")).save(folder / "rays.npz")
    small = {
        "radius": 0.5,
        "probes": 8,
        "steps": 2,
        "directions": 64,
        "validation_zones": 0,
        "min_rays": 8,
        "voxel_size": 0.3,
    }
    output = folder / "gaze.safetensors"
    train_gaze(folder / "rays.npz", "hits", test_zones=1, test_positions=3, **small, output=output)
    return folder


@pytest.fixture
def cube(tmp_path):
    """Return a folder with an opaque grey cube of density 50 as a field, and 3 photos of grey 0.5 with their poses."""
    import drjit.llvm.ad as ns
    import mitsuba as mi

    from nerg_mi.fields.encoding import HashGridConfig
    from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork
    from nerg_mi.formats.fields import save_radiance
    from nerg_mi.maths.geometry import Box

    mi.set_variant("llvm_ad_rgb")
    grid = HashGridConfig(levels=2, log2_rows=8, base=4, finest=8)
    config = RadianceConfig(grid=grid, width=16, color_hidden=1, density_scale=50.0)
    field = RadianceNetwork.random(config, Box((-1, -1, -1), (1, 1, 1)), ns, 0, march_step=0.05)
    field.set_parameters({k: type(v)(np.zeros(v.shape, np.float32)) for k, v in field.parameters().items()})
    frames = []
    for k in range(3):
        mi.Bitmap(np.full((14, 16, 3), 128, np.uint8)).write(str(tmp_path / f"{k}.png"))
        pose = np.eye(4)
        pose[:3, 3] = 0.05 * k, 0, 3
        frames.append({"file_path": f"{k}.png", "transform_matrix": pose.tolist()})
    lens = {"w": 16, "h": 14, "fl_x": 60.0, "fl_y": 60.0, "cx": 8.0, "cy": 7.0}
    transforms = {**lens, "frames": frames, "aabb": [[-1, -1, -1], [1, 1, 1]]}
    (tmp_path / "transforms.json").write_text(json.dumps(transforms))
    save_radiance(field, tmp_path / "cube.safetensors", {})
    return tmp_path


# ------------------------------------------------------------------------
#  Recorded data
# ------------------------------------------------------------------------


@pytest.fixture(scope="session")
def recorded():
    """`recorded("fox")` returns the folder of a recorded data set, in $NERG_DATA or in ../shared/data of the checkout.

    The data are not part of the repository; a test that needs missing data is skipped.
    """
    base = Path(os.environ.get("NERG_DATA", ROOT.parent / "shared" / "data"))

    def find(name: str) -> Path:
        if not (base / name).exists():
            pytest.skip(f'the recorded data "{name}" are not available: set NERG_DATA to their folder')
        return base / name

    return find
