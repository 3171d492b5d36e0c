"""A picture rendered in bands of rows, which bound the memory, and strips of samples, which bound the time of a
kernel, and taken apart into colour and AOVs."""

from __future__ import annotations

import functools
import math
import re
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import AnyGazeField
from nerg_mi.fields.mlp import set_constant_weights
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.maths.types import variant_types
from nerg_mi.transport.field_medium import FieldMedium

if TYPE_CHECKING:
    import mitsuba as mi


# ---- Several pictures of the same rays, and the one that an integrator makes of them ----


class LayerSource(Protocol):
    """What is rendered in place of a scene's integrator: several pictures of the same rays, each with AOVs of its
    own."""

    names: list[list[str]]
    """Names of the AOVs' channels of each picture."""

    count: int
    """Channels of AOVs that a picture with all of them would have: they are added up as there."""

    def sample(self, scene, sampler, ray, medium, active) -> Iterable[tuple]:
        """Of each picture, one after the other, ``(radiance, valid, aovs)`` as the ``sample`` of an integrator gives
        them."""
        ...


class IntegratorLayer:
    """The picture of an integrator, as the one layer."""

    def __init__(self, integrator):
        self.names, self._integrator = [integrator.aov_names()], integrator
        self.count = len(self.names[0])

    def sample(self, scene, sampler, ray, medium, active) -> Iterable[tuple]:
        return [self._integrator.sample(scene, sampler, ray, medium, active)]


# ---- Pace ----
#
# How a picture is divided into strips of samples, which an interruption and a report of progress can fall between.

PACKET = 64
"""Samples that Dr.Jit may add up as one (16 on a CPU, 32 on a GPU): a strip begins at a multiple of this many."""

LEAST = 1 << 12
"""Samples below which the overhead of a strip outweighs its work."""

STRIP_SECONDS = 0.5
"""A strip that took longer than this is followed by shorter ones, one that took less than half of it by longer ones."""


class SamplePace:
    """How many samples a strip has, from the time that those before it took; ``fixed``: always as many. It may serve
    several pictures in turn, in one variant."""

    def __init__(self, fixed: int = 0):
        import mitsuba as mi

        self._fixed = fixed
        self._count = fixed or (1 << 20 if str(mi.variant()).startswith("cuda") else 1 << 15)
        self._most = 1 << 24 if str(mi.variant()).startswith("cuda") else 1 << 18
        self._since, self._strips = 0.0, 0

    def begin(self) -> None:
        """A picture begins: what was done since the last one is no strip's time."""
        self._strips = 0

    def strips(self, start: int, stop: int, spp: int) -> Iterator[tuple[int, int]]:
        """``(first, count)`` of strips from sample ``start``, or from the packet that it lies in, to ``stop``."""
        # With whole pixels in every strip, unless a pixel alone has more samples than a strip may have.
        unit = math.lcm(PACKET, spp)
        unit = unit if unit <= self._most else PACKET
        first = start - start % PACKET
        while first < stop:
            last = min(max((first + self._count) // unit, first // unit + 1) * unit, stop)
            yield first, last - first
            first = last

    def wait(self) -> None:
        """Until the strip before is done."""
        import drjit as dr

        dr.sync_thread()
        now = time.perf_counter()
        # The first wait is for nothing, and the first strip's kernel had to be compiled.
        if self._strips > 1 and not self._fixed:
            seconds = now - self._since
            if seconds > STRIP_SECONDS:
                self._count = max(self._count // 2, LEAST)
            elif seconds < STRIP_SECONDS / 2:
                self._count = min(self._count * 2, self._most)
        self._since, self._strips = now, self._strips + 1


# ---- The random numbers of some pixels of a picture, without those of all others ----
#
# Mitsuba's ``independent`` sampler gives every sample of a picture its own PCG32 generator, whose state and stream are
# the seed and the number of the sample, scrambled (Tiny Encryption Algorithm). Thus the numbers of any range of samples
# can be had alone, and are those that they have in the whole picture.


def get_base_seed(sampler) -> int | None:
    """The ``seed`` of an ``independent`` sampler of Mitsuba; None for another kind, or for one that draws in another
    way."""
    import drjit as dr

    found = re.search(r"base_seed = (\d+)", str(sampler))
    if sampler.class_name() != "IndependentSampler" or not found:
        return None
    base, theirs, count = int(found[1]), sampler.clone(), 64
    theirs.seed(7, count)
    ours = make_strip_sampler(1, base, 7, 0, count)
    # Another release of Mitsuba may seed differently: its pictures are then rendered in one piece, and stay what they
    # are.
    return base if dr.all(theirs.next_2d() == ours.next_2d(), axis=None) else None


def make_strip_sampler(spp: int, base: int, seed: int, first: int, count: int):
    """A sampler for the samples ``first``, ..., ``first + count - 1`` of a picture with ``spp`` samples a pixel, which
    are counted pixel by pixel. ``base`` is the sampler's own seed and ``seed`` that of the render.

    Mitsuba renders at most 2^32 samples at once; beyond that the sequences are those of other seeds.
    """
    import drjit as dr

    mi = variant_types()
    number = dr.opaque(mi.UInt64, first) + mi.UInt64(dr.arange(mi.UInt32, count))
    low = mi.UInt32(number & 0xFFFFFFFF)
    high = mi.UInt32(number >> 32)
    key = dr.opaque(mi.UInt32, (base + seed) & 0xFFFFFFFF) + high * 0x9E3779B9
    state, stream = mi.sample_tea_32(key, low)
    return _class(mi.variant())(spp, mi.PCG32(initstate=mi.UInt64(state), initseq=mi.UInt64(stream)))


@functools.cache
def _class(variant: str):
    # Mitsuba's classes belong to a variant.
    import mitsuba as mi

    class StripSampler(mi.Sampler):
        def __init__(self, spp, generator):
            super().__init__(mi.Properties())
            self.set_sample_count(spp)
            self.generator = generator

        def next_1d(self, active=True):
            return self.generator.next_float32(mi.Bool(active))

        def next_2d(self, active=True):
            x = self.next_1d(active)
            return mi.Point2f(x, self.next_1d(active))

        def clone(self):
            return StripSampler(self.sample_count(), type(self.generator)(self.generator))

        def to_string(self):
            return f"Samples[{self.sample_count()} a pixel, {variant}]"

    return StripSampler


# ---- Bands ----
#
# A picture rendered in pieces: bands of rows, which bound the memory, in strips of samples, which bound the time of
# one step.
#
# A picture does not depend on how it is divided. Every sample keeps the position, the ray and the random numbers that
# it has in the whole picture (`pixel_sampler`), and the samples of a pixel are added in the same groups, so that with a
# box filter the pixels are those of ``mi.render``, bit by bit, also where a pixel's samples fall into two strips. With
# a wider filter the samples of the rows around a band are rendered again for it; what is added up is the same, in
# another order, and pixels differ by the rounding of single precision.

BYTES_PER_VALUE = 22
"""Memory that a band needs for each value (channel of a pixel), in bytes: 4 in the block that samples are added to, the
others in the copies on the way to the file."""


@runtime_checkable
class ObserverIntegrator(Protocol):
    """An integrator in Python that renders as `mi.SamplingIntegrator` does within a context of its own."""

    def rendering_from(self, sensor, scene) -> AbstractContextManager:
        """The context in which samples of ``sensor``'s picture of ``scene`` are traced."""
        ...


@dataclass(frozen=True)
class Band:
    """Rows ``top``, ..., ``top + rows - 1`` of the film's crop window. ``film`` holds them (``bitmap()``,
    ``develop()``) until the next band is asked for, perhaps followed by empty rows. ``layer``: number of the picture,
    where several are made of the same rays (`LayerSource`)."""

    top: int
    rows: int
    film: Any
    layer: int = 0


def undividable_reason(scene, sensor) -> str | None:
    """Why a picture of ``sensor`` can only be rendered in one piece; None where it can be divided."""
    import mitsuba as mi

    from nerg_mi.transport.observer import is_batch

    integrator, film = scene.integrator(), sensor.film()
    if str(mi.variant()).startswith("scalar") or mi.is_spectral or mi.is_polarized:
        return f"the variant {mi.variant()}"
    if not isinstance(integrator, mi.SamplingIntegrator) or isinstance(integrator, mi.CppADIntegrator):
        return f"the integrator {integrator.class_name()}"
    if not isinstance(integrator, ObserverIntegrator) and _renders_itself(type(integrator), mi.SamplingIntegrator):
        return f"the integrator {integrator.class_name()}, which renders in a way of its own"
    if film.class_name() != "HDRFilm":
        return f"the film {film.class_name()}"
    if is_batch(sensor):
        return "a batch of sensors"
    if get_base_seed(sensor.sampler()) is None:
        return f"the sampler {sensor.sampler().class_name()}"
    return None


def _renders_itself(kind: type, base: type) -> bool:
    """Whether a class of integrators in Python has a ``render`` of its own, below ``base``."""
    above = kind.__mro__
    return any("render" in vars(c) for c in above[: above.index(base)])


def fit_rows_to_memory(scene, sensor, memory: float) -> int:
    """Rows of a band that needs at most ``memory`` bytes; at least 1, and of a filter that is wider than a pixel so
    many that the rows around a band, which are rendered again for it, are a quarter of it at most."""
    width, height = sensor.film().crop_size()
    values = 5 + len(scene.integrator().aov_names())
    return int(min(max(memory // (width * values * BYTES_PER_VALUE), 8 * _reach(sensor.film()), 1), height))


def _reach(film) -> int:
    """How many rows further than their own the samples of ``film`` reach."""
    return 0 if film.rfilter().is_box_filter() else int(film.rfilter().border_size())


def render_bands(
    scene,
    sensor,
    *,
    spp: int = 0,
    seed: int = 0,
    rows: int = 0,
    strip: int = 0,
    on_strip: Callable[[int, int], None] | None = None,
    layers: LayerSource | None = None,
    pace: SamplePace | None = None,
) -> Iterator[Band]:
    """Render the picture of ``sensor`` band by band, from the top; in one piece where `why_whole` has a reason.

    ``spp``: samples a pixel, 0 for those of the sampler. ``rows`` of a band; 0: all. ``strip``: samples of a strip, 0:
    as many as take about `bands.STRIP_SECONDS`; ``pace``: that of the pictures before this one. ``on_strip`` is told
    the number of samples done and that of all after every strip, and may raise. ``layers``: in place of the scene's
    integrator, of a picture that can be divided; the bands of all of them follow each other. Raises
    ``KeyboardInterrupt`` after a picture in one piece that was to be stopped: there Mitsuba itself takes the signal.
    """
    if undividable_reason(scene, sensor):
        yield _whole(scene, sensor, spp, seed, on_strip)
        return
    grid = _Grid(sensor.film(), spp or sensor.sampler().sample_count(), rows)
    integrator = scene.integrator()
    layers = IntegratorLayer(integrator) if layers is None else layers
    observing = lambda: integrator.rendering_from(sensor, scene) if isinstance(integrator, ObserverIntegrator) else nullcontext()
    base = get_base_seed(sensor.sampler())
    pace = pace or SamplePace(strip)
    pace.begin()
    done = 0
    for top in range(0, grid.height, grid.rows):
        blocks = [grid.block(names) for names in layers.names]
        start, stop = grid.samples(top)
        with observing(), grid.as_whole(blocks[0], layers):
            for first, count in pace.strips(start, stop, grid.spp):
                where, active, found = _trace(scene, sensor, layers, grid, base, seed, top, first, count, start)
                for block, values in zip(blocks, found):
                    block.put(where, values, active)
                    if len(blocks) > 1:
                        # Each in a kernel of its own, which layers of one kind then have in common.
                        _evaluate(block)
                # What was traced while the strip before it was computed is computed now.
                pace.wait()
                if on_strip is not None and done:
                    on_strip(min(done, grid.total), grid.total)
                for block in blocks:
                    _evaluate(block)
                done += count
            pace.wait()
        if on_strip is not None:
            on_strip(min(done, grid.total), grid.total)
        for layer, (names, block) in enumerate(zip(layers.names, blocks)):
            grid.develop(names, block)
            yield Band(top, min(grid.rows, grid.height - top), sensor.film(), layer)


def _whole(scene, sensor, spp, seed, on_strip) -> Band:
    import drjit as dr
    import mitsuba as mi

    mi.render(scene, sensor=sensor, spp=spp, seed=seed)
    dr.sync_thread()
    if scene.integrator().should_stop():
        raise KeyboardInterrupt
    if on_strip is not None:
        total = int(np.prod(sensor.film().crop_size())) * (spp or sensor.sampler().sample_count())
        on_strip(total, total)
    return Band(0, int(sensor.film().crop_size()[1]), sensor.film())


def _evaluate(block):
    import drjit as dr

    dr.eval(block.tensor())


def _trace(scene, sensor, layers: LayerSource, grid: _Grid, base, seed, top, first, count, start):
    """Trace samples ``first``, ..., of which those before ``start`` are of no account: where they lie in the block of
    the band at ``top``, who counts, and an iterator over their values in each layer. Follows
    ``SamplingIntegrator::render_sample`` of Mitsuba 3.9, operation by operation."""
    import drjit as dr

    mi = variant_types()
    film, spp = sensor.film(), grid.spp
    sampler = make_strip_sampler(spp, base, seed, first, count)
    # Numbers that differ from strip to strip are kept out of the kernel, which is then the same for all.
    number = dr.arange(mi.UInt32, count)
    active = number >= dr.opaque(mi.UInt32, max(start - first, 0))
    number += dr.opaque(mi.UInt32, first % spp)
    number = number // dr.opaque(mi.UInt32, spp) + dr.opaque(mi.UInt32, first // spp % grid.width)
    line = number // grid.width
    pixel = mi.Vector2i(number - line * grid.width, line + dr.opaque(mi.UInt32, first // spp // grid.width))
    pixel += mi.Vector2i(film.crop_offset()) - grid.border

    position = mi.Vector2f(pixel) + sampler.next_2d(active)
    scale = dr.rcp(mi.ScalarVector2f(film.crop_size()))
    offset = -mi.ScalarVector2f(film.crop_offset()) * scale
    relative = mi.Point2f(dr.fma(position, mi.Vector2f(scale), mi.Vector2f(offset)))
    aperture = sampler.next_2d(active) if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    moment = sensor.shutter_open()
    if sensor.shutter_open_time() > 0:
        moment = moment + sampler.next_1d(active) * sensor.shutter_open_time()
    ray, weight = sensor.sample_ray_differential(moment, 0, relative, aperture, active)
    if ray.has_differentials:
        ray.scale_differential(mi.Float(np.float32(1) / np.sqrt(np.float32(spp))))
    found = layers.sample(scene, sampler, ray, sensor.get_medium(), active)
    # With a box filter the pixel itself, as its samples may be rounded up into the next.
    where = mi.Point2f(pixel) if film.rfilter().is_box_filter() else mi.Point2f(position)
    if grid.divided:
        where -= mi.Vector2f(mi.Vector2i(film.crop_offset()) + mi.Vector2i(0, dr.opaque(mi.Int32, top)))
    return where, active, (_values(film, weight, *of_layer) for of_layer in found)


def _values(film, weight, radiance, valid, aovs) -> list:
    """What is added to a film's block for each sample."""
    import drjit as dr
    import mitsuba as mi

    radiance = mi.Spectrum(radiance) * weight
    color = [radiance.x] * 3 if mi.is_monochromatic else [radiance.x, radiance.y, radiance.z]
    alpha = [dr.select(valid, mi.Float(1), 0)] if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else []
    return [*color, *alpha, mi.Float(1), *aovs]


class _Grid:
    """Pixels that are sampled, row by row, and the bands of them."""

    def __init__(self, film, spp: int, rows: int):
        self.film, self.spp = film, spp
        self.size, self.offset = [int(v) for v in film.crop_size()], [int(v) for v in film.crop_offset()]
        self.height = self.size[1]
        self.rows = min(rows or self.height, self.height)
        self.divided = self.rows < self.height
        filters = film.rfilter()
        self.border = int(filters.border_size()) if film.sample_border() else 0
        self._reach = _reach(film)
        self.width = self.size[0] + 2 * self.border
        self.total = sum(b - a for a, b in map(self.samples, range(0, self.height, self.rows)))

    def samples(self, top: int) -> tuple[int, int]:
        """The samples, of those of the whole picture, that reach the band at ``top``: the first, and the one after the
        last."""
        first = max(top - self._reach + self.border, 0)
        last = min(top + self.rows + self._reach + self.border, self.height + 2 * self.border)
        if not self.divided:
            first, last = 0, self.height + 2 * self.border
        return first * self.width * self.spp, last * self.width * self.spp

    def block(self, aov_names: list[str]):
        """What the samples of a band are added to."""
        with self._cropped():
            self.film.prepare(aov_names)
            block = self.film.create_block()
            block.set_offset(self.film.crop_offset())
        block.set_coalesce(block.coalesce() and self.spp >= 4)
        return block

    @contextmanager
    def as_whole(self, block, layers: LayerSource):
        """Add samples to ``block``, that of the first of ``layers``, and to the others, in the way in which Dr.Jit
        would add them to the whole picture, which is another for more than a million values
        (`dr.set_expand_threshold`) and rounds differently."""
        import drjit as dr

        threshold = dr.expand_threshold()
        channels = block.channel_count() - len(layers.names[0]) + layers.count
        if self.size[0] * self.size[1] * channels > threshold:
            dr.set_expand_threshold(0)
        try:
            yield
        finally:
            dr.set_expand_threshold(threshold)

    def develop(self, aov_names: list[str], block) -> None:
        """Let the film hold what is in ``block``."""
        with self._cropped():
            self.film.prepare(aov_names)
            self.film.put_block(block)

    @contextmanager
    def _cropped(self):
        # Only for as long as no ray is made: sensors see the whole film. All bands lie at the film's corner, so that
        # the place of a band is not part of the kernel.
        if not self.divided:
            yield
            return
        _crop(self.film, [self.size[0], self.rows], [0, 0])
        try:
            yield
        finally:
            _crop(self.film, self.size, self.offset)


def _crop(film, size, offset) -> None:
    import mitsuba as mi

    params = mi.traverse(film)
    params["crop_size"], params["crop_offset"] = mi.ScalarVector2u(size), mi.ScalarPoint2u(offset)
    params.update()


# ---- Channels ----
#
# A picture taken apart: its colour and its AOVs as arrays.

SURFACE_OPACITY = 0.5
"""Opacity from which on a pixel shows a surface, as the integrator has it by default."""


@dataclass(frozen=True, eq=False)
class Channels:
    """``color`` (h, w, 3): linear radiance; ``aovs``: (h, w) each, by name, a vector's as ``position.X``; ``bitmap``:
    Mitsuba's, with all channels."""

    color: np.ndarray
    aovs: dict[str, np.ndarray]
    bitmap: mi.Bitmap

    @property
    def mask(self) -> np.ndarray:
        """Where there is a surface (h, w), bool; needs the AOV ``opacity``."""
        return self.aovs["opacity"] >= SURFACE_OPACITY


def render_channels(
    scene, sensor, spp: int = 0, seed: int = 0, on_strip: Callable[[int, int], None] | None = None
) -> Channels:
    """Render what ``sensor`` sees of ``scene`` (`mi.Scene`) with the scene's integrator, as ``mi.render`` does.

    ``spp``: samples a pixel, 0 for those of the sensor's sampler. ``on_strip`` is told the samples done and those of
    all, several times a second, and may raise.
    """
    (band,) = render_bands(scene, sensor, spp=spp, seed=seed, on_strip=on_strip)
    return read_channels(band.film, scene.integrator().aov_names())


def read_channels(film, aov_names: Sequence[str]) -> Channels:
    """What a developed ``film`` holds, whose last channels are those of AOVs, with these names."""
    names = [name.split(".") for name in aov_names]
    pixels = np.array(film.develop())
    color = pixels[..., : pixels.shape[2] - len(names)]
    first = color.shape[2]
    several = {parts[0] for parts in names if [p[0] for p in names].count(parts[0]) > 1}
    key = lambda parts: ".".join(parts) if parts[0] in several else parts[0]
    aovs = {key(parts): pixels[..., first + k] for k, parts in enumerate(names)}
    # Mono variants render one channel.
    return Channels(np.broadcast_to(color[..., :3], (*color.shape[:2], 3)), aovs, film.bitmap())


# ---- The integrator `nerg` of a scene asked for AOVs that its own list may lack, for the scene's own observer ----


class AovLayer:
    """What is rendered in place of a scene's own picture (`LayerSource`): colour, and the AOVs ``names_asked``.

    Raises `NergError` for those that ``integrator``, a `nerg`, cannot compute.
    """

    def __init__(self, integrator: Any, sensor: Any, names_asked: Sequence[str]):
        self._sensor, self._context = sensor, integrator.make_context(names_asked, True)
        self.names = [self._context.channel_names(self._context.aovs)]
        self.count = len(self.names[0])

    def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any, active: Any) -> Iterable[tuple]:
        camera = self._context.trace(scene, [self._sensor], sampler, ray, active)
        channels = camera.make_pixel().compute_channels(self._context.aovs)
        radiance, shown, _ = camera.compute_radiance(scene, sampler, medium)
        return [(radiance, shown, channels)]


def is_nerg(integrator: Any) -> bool:
    """Whether an integrator, or None, is `nerg`: by name, since each change of variant makes that class anew."""
    return type(integrator).__name__ == "NergIntegrator"


def require_nerg(path: Path, scene: Any) -> Any:
    """The integrator of ``scene``, which was read from ``path``. Raises `NergError` where it is not `nerg`."""
    integrator = scene.integrator()
    if not is_nerg(integrator):
        kind = "none" if integrator is None else f'"{integrator.class_name()}"'
        raise NergError(
            f'an overlay needs the integrator "nerg", and "{path}" has {kind}; "nerg scene {path} -o new.xml" writes '
            "one around it"
        )
    return integrator


def render_aovs(
    path: Path,
    scene: Any,
    sensor: Any,
    names: Sequence[str],
    spp: int = 0,
    seed: int = 0,
    on_strip: Callable[[int, int], None] | None = None,
) -> Channels:
    """Colour and the AOVs ``names`` of what ``sensor`` sees of ``scene``, which was read from ``path``.

    Raises `NergError` for a scene whose integrator is not `nerg`, for AOVs that this cannot compute, and for pictures
    that are made in one piece only (`why_whole`).
    """
    integrator = require_nerg(path, scene)
    reason = undividable_reason(scene, sensor)
    if reason is not None:
        raise NergError(f'"{path}" cannot be rendered with an overlay because of {reason}; choose another sensor')
    layer = AovLayer(integrator, sensor, names)
    (band,) = render_bands(scene, sensor, spp=spp, seed=seed, on_strip=on_strip, layers=layer)
    return read_channels(band.film, layer.names[0])


# ---- Long renders ----
#
# What pays only where many samples are rendered of one scene: kernels that know the weights of its fields.

LONG_RENDER_SAMPLES = 1 << 27
"""From so many on a render is long: 146 pictures of 1280 x 720 pay for some seconds of compilation many times."""


def prepare_long_render(samples: int, scene: Any) -> bool:
    """Make ready ``scene`` for so many ``samples``, without a change of what it shows; whether there was anything to
    do."""
    integrator = scene.integrator()
    if samples < LONG_RENDER_SAMPLES or not is_nerg(integrator):
        return False
    found = get_trained_fields(integrator)
    for field in found:
        set_constant_weights(field)
    return bool(found)


def get_trained_fields(integrator: Any) -> list[RadianceField | AnyGazeField]:
    """The trained fields of an integrator `nerg`, those that it has: of its radiance, of its gaze."""
    medium, gaze = integrator.medium, integrator.gaze
    found: list[RadianceField | AnyGazeField] = [medium.field] if isinstance(medium, FieldMedium) else []
    return found if gaze is None else [*found, gaze.field]
