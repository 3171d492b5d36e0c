"""From a scene file to a picture file, with the integrator that the scene names."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from pathlib import Path

from .errors import NergError, UnusableLLVM, sentence
from .formats.atomic import check_writable
from .formats.exr import write_bitmap_exr
from .formats.png import write_png

_FORMATS = (".exr", ".png")
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

    from . import llvm

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
) -> str:
    """Render the scene file `scene`, write the picture `output`, and give a sentence that says what was done.

    `output` ends in .exr (all channels of the film, AOVs among them, as float32) or in .png (its colour, tonemapped to
    sRGB); its folder is made. `defaults`: values for the `<default>` and `$key` of the scene. `sensor`: index. `spp`:
    samples a pixel, 0 for those of the scene's sampler. `threads`: 0 for one a core. Raises NergError for what the user can mend.
    """
    scene, output = Path(scene), Path(output)
    check_writable(output, *_FORMATS)
    if not scene.is_file():
        raise NergError(f'there is no scene file "{scene}".')
    active = activate(variant)

    import drjit as dr
    import mitsuba as mi

    if threads:
        dr.set_thread_count(threads)
    start = time.perf_counter()
    try:
        loaded = mi.load_file(str(scene), **(defaults or {}))
    except RuntimeError as error:
        raise NergError(sentence(error)) from error
    count = len(loaded.sensors())
    if not 0 <= sensor < count:
        raise NergError(f'"{scene}" has {count} sensor(s) and number {sensor} was asked for: choose -s from 0 on.')
    try:
        mi.render(loaded, sensor=sensor, spp=spp, seed=seed)
        bitmap = loaded.sensors()[sensor].film().bitmap()
    except RuntimeError as error:
        raise NergError(sentence(error)) from error

    _write(mi, bitmap, output)
    width, height = bitmap.size()
    seconds = time.perf_counter() - start
    return f"Wrote {output} ({width} x {height}, {bitmap.channel_count()} channels, {active}, {seconds:.1f} s)."


def _write(mi, bitmap, output: Path) -> None:
    if output.suffix.lower() == ".exr":
        # float32 whatever the component_format of the film, which counts only where the film writes itself
        write_bitmap_exr(output, bitmap)
        return
    # With AOVs the bitmap has many channels, of which the colour is the layer without a name.
    if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel:
        bitmap = dict(bitmap.split())["<root>"]
    write_png(output, mi.util.convert_to_bitmap(bitmap))
