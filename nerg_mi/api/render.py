"""Pictures of a scene: for its own observer, or for many whose gaze is shown in one view."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError, translate_mitsuba_errors
from nerg_mi.ranges import SEEDS, SPP, Range, check_number
from nerg_mi.workflows.base import SILENT, Reporter

from .arrays import Camera, Floats, LabelledArrays, as_points, broadcast_to_observers
from .scene import COLOR, FilePath, Scene, activate_mitsuba, resolve_quantities, make_aov_context

if TYPE_CHECKING:
    import mitsuba as mi


AXES = ("observer", "row", "column")


@dataclass(frozen=True, eq=False, repr=False)
class Pictures(LabelledArrays):
    """Quantities of `render`, each (observers, height, width) or, with channels, (observers, height, width, channels):
    ``pictures["gaze"][0]`` or ``pictures.gaze[0]`` is the first observer's."""


def render(
    scene: Scene | FilePath,
    observers: ArrayLike | None = None,
    quantities: str | Sequence[str] | None = None,
    *,
    camera: Camera | int | mi.Sensor | None = None,
    spp: int = 0,
    seed: int = 0,
    reporter: Reporter = SILENT,
) -> Pictures:
    """Render a scene, or a scene file, for one or many observers.

    ``observers``: positions (M, 3) in scene units of those whose gaze is shown, or one (3,); None: the scene's own,
    which is the camera where it has none. ``quantities``: ``"color"`` (linear rgb; the luminance in mono variants) and
    any AOV of the integrator ``nerg``: ``depth`` and ``observer_depth`` (scene units), ``opacity``, ``position``,
    ``gaze`` (1/sr), ``visibility``, ``support``, ...; without any ``color``, ``depth``, ``opacity`` and, where there is
    a gaze field, ``gaze`` and ``visibility``. ``camera``: a `Camera`, or the number of one of the scene's own (the
    first). ``spp``: samples a pixel, 0 for as many as the scene says. Equal seeds give equal pictures, and those of
    ``nerg render`` to the bit where the camera has a box filter, as every `Camera` has.

    The camera's rays are traced once for all observers, and kernels are compiled for one of them. Raises `NergError`,
    and ``KeyboardInterrupt`` after Ctrl-C.

    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> scene = nerg.Scene.load(store / "scene.xml", width=48, height=32)
    >>> pictures = nerg.render(scene, observers=[(4.4, 2.8, 1.6), (6.3, 3.0, 1.6)], quantities=["depth", "gaze"], spp=1)
    >>> pictures
    Pictures(observer 2, row 32, column 48)
      depth  (2, 32, 48), float32
      gaze   (2, 32, 48), float32
    """
    scene = Scene.coerce(scene)
    activate_mitsuba()
    asked = resolve_quantities(scene, quantities)
    sensor = scene.resolve_sensor(camera)
    _check_counts(spp, seed)
    with translate_mitsuba_errors():
        context = make_aov_context(scene, asked)
        eyes = _observers(scene, sensor, observers, bool(context.observer_aovs))
        layers = _Layers(context, sensor, asked, eyes)
        values = _render(scene, sensor, layers, int(spp), int(seed), reporter)
    return Pictures({name: values[name] for name in asked}, AXES, eyes)


def _observers(scene: Scene, sensor: Any, given: ArrayLike | None, needed: bool) -> Floats:
    """Positions (M, 3) of the observers of a picture; ``needed``: whether it depends on them."""
    from nerg_mi.transport import observer

    if given is not None:
        return as_points(given, "observers")
    if scene.observer is not None:
        return scene.observer[None]
    if needed:
        observer.check_center(sensor, "the camera")
    return np.array(observer.sensor_center(sensor), np.float32).reshape(1, 3)


class _Layers:
    """What `nerg_mi.rendering.bands.render_bands` renders: first what all observers have in common, then, for each of
    them, what does not."""

    def __init__(self, context: Any, sensor: Any, asked: Sequence[str], eyes: Floats):
        self.sensor, self.color, self.observers = sensor, COLOR in asked, len(eyes)
        self.context = context
        self.shared, self.own = context.shared_aovs, context.observer_aovs
        self.lookers = [context.make_observer(eye, len(eyes) == 1) for eye in eyes] if self.own else []
        shared, own = (context.channel_names(names) for names in (self.shared, self.own))
        self.names, self.count = [shared, *(own for _ in self.lookers)], len(shared) + len(own)

    def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any, active: Any) -> Iterator[tuple]:
        camera = self.context.trace(scene, [self.sensor], sampler, ray, active)
        shared = camera.compute_channels(self.shared)
        radiance, shown, _ = camera.compute_radiance(scene, sampler, medium)
        if self.lookers:
            camera.eval_shared(radiance, shown, shared)
        yield radiance, shown, shared
        for looker in self.lookers:
            yield 0, shown, camera.make_pixel(looker).compute_channels(self.own)

    def split(self, layer: int, pixels: Floats) -> dict[str, Floats]:
        """The channels (height, width, C) of a layer by quantity."""
        alpha = _has_alpha(self.sensor.film())
        first = ([COLOR] if self.color else []) + self.shared
        return split_channels(pixels, self.names[layer], self.own if layer else first, alpha)


def _render(scene: Scene, sensor: Any, layers: _Layers, spp: int, seed: int, reporter: Reporter) -> dict[str, Floats]:
    """All quantities, each with an axis of observers in front."""
    from nerg_mi.interruption import Interruption
    from nerg_mi.rendering.bands import render_bands, undividable_reason

    reason = undividable_reason(scene.mitsuba, sensor)
    if reason is not None:
        raise NergError(f"this camera's rays cannot be shared between observers because of {reason}; give a Camera")
    with Interruption() as stop:

        def on_strip(done: int, total: int) -> None:
            stop.check()
            reporter.progress(done / total, f"{done:,} of {total:,} samples")

        bands = render_bands(scene.mitsuba, sensor, spp=spp, seed=seed, on_strip=on_strip, layers=layers)
        parts = [layers.split(band.layer, np.array(band.film.develop(), np.float32)) for band in bands]
        stop.check()
    common, *each = parts
    values = {name: broadcast_to_observers(value, layers.observers) for name, value in common.items()}
    return values | {name: np.stack([one[name] for one in each]) for name in layers.own}


def split_channels(pixels: Floats, aov_names: Sequence[str], quantities: Sequence[str], alpha: bool) -> dict[str, Floats]:
    """The channels (height, width, C) of a film by quantity: colour in front, perhaps ``alpha``, the AOVs at the
    end."""
    first = pixels.shape[-1] - len(aov_names)
    columns: dict[str, list[int]] = {}
    for i, name in enumerate(aov_names):
        columns.setdefault(name.rpartition(".")[0], []).append(first + i)
    out = {}
    for name in quantities:
        if name == COLOR:
            out[name] = np.ascontiguousarray(pixels[..., : first - alpha])
        else:
            where = columns[name]
            out[name] = np.ascontiguousarray(pixels[..., where[0]] if len(where) == 1 else pixels[..., where])
    return out


def _has_alpha(film: Any) -> bool:
    import mitsuba as mi

    return bool(mi.has_flag(film.flags(), mi.FilmFlags.Alpha))


def _check_counts(spp: int, seed: int) -> None:
    check_number(spp, Range(0, SPP.high), "spp", is_integer=True)
    check_number(seed, SEEDS, "seed", is_integer=True)
