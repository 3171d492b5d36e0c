"""From a scene file to a picture file, with the integrator that the scene names."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from nerg_mi.errors import NergError, UnusableLLVM, mitsuba_says, sentence
from nerg_mi.files.atomic import check_writable
from nerg_mi.files.exr import threads_for_mitsuba
from nerg_mi.interruption import Interruption

from . import bands
from .picture_file import FORMATS, picture_rows
from .scene_file import check_samples, check_scene, check_scene_file

RESERVE = 150e6
"""Bytes kept free beside a band, for the strips in it and for the kernel that is compiled first."""

_PREFERRED = ("cuda_ad_rgb", "llvm_ad_rgb")


def parse_defines(pairs: Iterable[str]) -> dict[str, str]:
    """`["spp=4", "name=a=b"]` as `{"spp": "4", "name": "a=b"}`. Raises NergError for a pair without a key or a "="."""
    values = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not (key and equals):
            raise NergError(f'"-D {pair}" is no definition: write -D key=value.')
        values[key] = value
    return values


def activate(variant: str | None = None) -> str:
    """Make a Mitsuba variant the active one, with the plugins of this package, and give its name.

    `variant` None: `cuda_ad_rgb` where there is an NVIDIA driver, otherwise `llvm_ad_rgb`. Raises NergError for a name
    that Mitsuba does not know and for a variant that does not work here.
    """
    import mitsuba as mi

    from nerg_mi import llvm

    if variant is not None and variant not in mi.variants():
        raise NergError(f'there is no variant "{variant}"; this Mitsuba has {", ".join(mi.variants())}.')
    wanted = [variant] if variant else [v for v in _PREFERRED if not v.startswith("cuda") or llvm.has_cuda()]
    for choice in wanted:
        try:
            mi.set_variant(choice)
            return choice
        except UnusableLLVM:
            raise
        except ImportError as error:  # Mitsuba says so where the backend of a variant cannot start
            failed = error
    said = sentence(failed)
    raise NergError(f'the variant "{wanted[-1]}" does not work here ({said}); "nerg doctor" says how to mend it.')


def load_scene(path: str | Path, defaults: Mapping[str, str] | None = None):
    """The scene of a file, with ``defaults`` for its `<default>` and `$key`; the variant must be active.

    Raises NergError for what Mitsuba does not take, and for what would end its process or fill the memory.
    """
    import mitsuba as mi

    if not Path(path).is_file():
        raise NergError(f'there is no scene file "{path}".')
    check_scene_file(path, defaults)
    with mitsuba_says(), threads_for_mitsuba():
        try:
            loaded = mi.load_file(str(path), **(defaults or {}))
        except RuntimeError as error:
            unused = (
                re.findall(r"^\s*- \$(\w+)=", str(error), re.MULTILINE) if "unused parameters" in str(error) else []
            )
            if unused:
                raise NergError(
                    f'the scene "{path}" asks for no "${unused[0]}": correct the name that is given a value.'
                ) from error
            raise
        except UnicodeDecodeError as error:
            # Mitsuba quotes what it cannot read, and that is no text.
            raise NergError(
                f'a mesh or another file that the scene "{path}" names is damaged: make it anew.'
            ) from error
    check_scene(path, loaded)
    return loaded


def render_file(
    scene: str | Path,
    output: str | Path,
    *,
    defaults: Mapping[str, str] | None = None,
    sensor: int = 0,
    variant: str | None = None,
    spp: int = 0,
    seed: int = 0,
    threads: int = 0,
    memory: float = 1.0,
    on_progress: Callable[[int, int], None] | None = None,
) -> str:
    """Render the scene file `scene`, write the picture `output`, and give a sentence that says what was done.

    `output` ends in .exr (all channels of the film, AOVs among them, as float32) or in .png (its colour, tonemapped to
    sRGB); its folder is made. `defaults`: values for the `<default>` and `$key` of the scene. `sensor`: index. `spp`:
    samples a pixel, 0 for those of the scene's sampler. `threads`: 0 for one a core.

    `memory`: what the process may take, in GB. A picture that needs more is rendered in bands of rows, as large as fit
    beside what the scene itself takes. Its pixels do not depend on that where the film has a box filter; with wider
    filters they differ by the rounding of single precision (`bands`). Samplers other than `independent`, films other
    than `hdrfilm`, scalar and spectral variants and Mitsuba's differentiable integrators are rendered in one piece, and
    the sentence says so where that is more than `memory`. `on_progress` is told the samples done and the samples of
    all.

    Raises NergError for what the user can mend, and KeyboardInterrupt, between two steps of less than a second, after
    Ctrl-C.
    """
    scene, output = Path(scene), Path(output)
    check_writable(output, *FORMATS)
    if not memory > 0:
        raise NergError(f"the memory to render in is {memory} GB: give it more than 0.")
    if spp:
        check_samples(spp, "the picture")
    if not scene.is_file():
        raise NergError(f'there is no scene file "{scene}".')
    active = activate(variant)

    import drjit as dr

    if threads:
        dr.set_thread_count(threads)
    start = time.perf_counter()
    with Interruption() as stop:

        def on_strip(done: int, total: int) -> None:
            stop.check()
            if on_progress is not None:
                on_progress(done, total)

        loaded = load_scene(scene, defaults)
        stop.check()
        count = len(loaded.sensors())
        if not 0 <= sensor < count:
            raise NergError(f'"{scene}" has {count} sensor(s) and number {sensor} was asked for: choose -s from 0 on.')
        camera = loaded.sensors()[sensor]
        width, height = map(int, camera.film().crop_size())
        whole = bands.why_whole(loaded, camera)
        rows = bands.rows_for(loaded, camera, 1e9 * memory - resident_bytes() - RESERVE)
        with mitsuba_says(), picture_rows(output, width, height) as write:
            for band in bands.render_bands(loaded, camera, spp=spp, seed=seed, rows=rows, on_strip=on_strip):
                bitmap = band.film.bitmap()
                channels = bitmap.channel_count()
                write(bitmap, band.rows)
                stop.check()
        # The picture is there, and yet whoever called this does not go on.
        stop.check()
    seconds = time.perf_counter() - start
    note = (
        f" It was rendered in one piece, beyond {memory:g} GB, because of {whole}." if whole and rows < height else ""
    )
    return f"Wrote {output} ({width} x {height}, {channels} channels, {active}, {seconds:.1f} s).{note}"


def resident_bytes() -> int:
    """Bytes of memory that this process takes; where the system does not say, the most that it ever took."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        import resource
        import sys

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
