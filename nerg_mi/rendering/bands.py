"""A picture rendered in pieces: bands of rows, which bound the memory, in strips of samples, which bound the time of
one step.

A picture does not depend on how it is divided. Every sample keeps the position, the ray and the random numbers that it
has in the whole picture (`pixel_sampler`), and the samples of a pixel are added in the same groups, so that with a box
filter the pixels are those of ``mi.render``, bit by bit, also where a pixel's samples fall into two strips. With a
wider filter the samples of the rows around a band are rendered again for it; what is added up is the same, in another
order, and pixels differ by the rounding of single precision.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from nerg_mi.maths.types import variant_types

from . import pixel_sampler
from .layers import Layers, OwnLayer
from .pace import Pace

BYTES_PER_VALUE = 22
"""Memory that a band needs for each value (channel of a pixel), in bytes: 4 in the block that samples are added to, the
others in the copies on the way to the file."""


@runtime_checkable
class Observing(Protocol):
    """An integrator in Python that renders as `mi.SamplingIntegrator` does within a context of its own."""

    def seen_by(self, sensor, scene) -> AbstractContextManager:
        """The context in which samples of ``sensor``'s picture of ``scene`` are traced."""
        ...


@dataclass(frozen=True)
class Band:
    """Rows ``top``, ..., ``top + rows - 1`` of the film's crop window. ``film`` holds them (``bitmap()``,
    ``develop()``) until the next band is asked for, perhaps followed by empty rows. ``layer``: number of the picture,
    where several are made of the same rays (`layers.Layers`)."""

    top: int
    rows: int
    film: Any
    layer: int = 0


def why_whole(scene, sensor) -> str | None:
    """Why a picture of ``sensor`` can only be rendered in one piece; None where it can be divided."""
    import mitsuba as mi

    from nerg_mi.transport.observer import is_batch

    integrator, film = scene.integrator(), sensor.film()
    if str(mi.variant()).startswith("scalar") or mi.is_spectral or mi.is_polarized:
        return f"the variant {mi.variant()}"
    if not isinstance(integrator, mi.SamplingIntegrator) or isinstance(integrator, mi.CppADIntegrator):
        return f"the integrator {integrator.class_name()}"
    if not isinstance(integrator, Observing) and _renders_itself(type(integrator), mi.SamplingIntegrator):
        return f"the integrator {integrator.class_name()}, which renders in a way of its own"
    if film.class_name() != "HDRFilm":
        return f"the film {film.class_name()}"
    if is_batch(sensor):
        return "a batch of sensors"
    if pixel_sampler.base_seed(sensor.sampler()) is None:
        return f"the sampler {sensor.sampler().class_name()}"
    return None


def _renders_itself(kind: type, base: type) -> bool:
    """Whether a class of integrators in Python has a ``render`` of its own, below ``base``."""
    above = kind.__mro__
    return any("render" in vars(c) for c in above[: above.index(base)])


def rows_for(scene, sensor, memory: float) -> int:
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
    layers: Layers | None = None,
    pace: Pace | None = None,
) -> Iterator[Band]:
    """Render the picture of ``sensor`` band by band, from the top; in one piece where `why_whole` has a reason.

    ``spp``: samples a pixel, 0 for those of the sampler. ``rows`` of a band; 0: all. ``strip``: samples of a strip, 0:
    as many as take about `pace.STRIP_SECONDS`; ``pace``: that of the pictures before this one. ``on_strip`` is told the
    number of samples done and that of all after every strip, and may raise. ``layers``: in place of the scene's
    integrator, of a picture that can be divided; the bands of all of them follow each other. Raises
    ``KeyboardInterrupt`` after a picture in one piece that was to be stopped: there Mitsuba itself takes the signal.
    """
    if why_whole(scene, sensor):
        yield _whole(scene, sensor, spp, seed, on_strip)
        return
    grid = _Grid(sensor.film(), spp or sensor.sampler().sample_count(), rows)
    integrator = scene.integrator()
    layers = OwnLayer(integrator) if layers is None else layers
    observing = lambda: integrator.seen_by(sensor, scene) if isinstance(integrator, Observing) else nullcontext()
    base = pixel_sampler.base_seed(sensor.sampler())
    pace = pace or Pace(strip)
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


def _trace(scene, sensor, layers: Layers, grid: _Grid, base, seed, top, first, count, start):
    """Trace samples ``first``, ..., of which those before ``start`` are of no account: where they lie in the block of
    the band at ``top``, who counts, and an iterator over their values in each layer. Follows
    ``SamplingIntegrator::render_sample`` of Mitsuba 3.9, operation by operation."""
    import drjit as dr

    mi = variant_types()
    film, spp = sensor.film(), grid.spp
    sampler = pixel_sampler.for_samples(spp, base, seed, first, count)
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
    def as_whole(self, block, layers: Layers):
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
