"""Rendering of images, for one or many observers in one view."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.environment.arrays import Camera, Floats, LabelledArrays, as_points, broadcast_to_observers
from nerg_mi.environment.queries import warn_extrapolation
from nerg_mi.environment.scene import COLOR, Scene, make_aov_context, resolve_quantities
from nerg_mi.environment.scene_loading import activate_mitsuba
from nerg_mi.errors import NergError, translate_mitsuba_errors
from nerg_mi.files.html import image, markup, paragraph
from nerg_mi.files.values import FilePath
from nerg_mi.maths.types import Axes, Figure, Sensor
from nerg_mi.progress import Progress, Reporter, open_reporter
from nerg_mi.ranges import SEEDS, SPP, Range, check_number
from nerg_mi.transport.geometry import SURFACE_OPACITY
from nerg_mi.transport.recording import Recorder

from .style import show_figure

AXES = ("observer", "row", "column")

_NO_COLOR = 0.2
"""Linear grey below a quantity if the colour was not rendered."""


@dataclass(frozen=True, eq=False, repr=False)
class Pictures(LabelledArrays):
    """Result of `render`.

    The arrays have the shape (observers, height, width) or (observers, height, width, channels): ``result["gaze"][0]``
    and ``result.gaze[0]`` are the gaze of the first observer.
    """

    def plot(self, name: str | None = None, observer: int = 0, *, axes: Axes | None = None) -> Figure:
        """Draw the image as a figure: its colour, with a quantity over it.

        Parameters
        ----------
        name : str, optional
            The quantity. Default: ``gaze`` if there is one, else ``color``, else the first one. It is drawn over the
            colour, or over grey without it; pixels without a surface are hatched if there is ``opacity``.
        observer : int
            Index of the observer.
        axes : matplotlib.axes.Axes, optional
            Axes to draw in. Default: a new figure.

        Returns
        -------
        matplotlib.figure.Figure
            The figure, which a notebook shows and its method ``savefig`` writes. If pyplot is imported, and not in a
            notebook, a new figure is also its current one, until ``pyplot.close``.

        Raises
        ------
        NergError
            The result lacks the quantity or the observer; nothing is drawn then.

        Examples
        --------
        >>> import nerg_mi as nerg
        >>> from importlib.resources import files
        >>> scene = nerg.Scene.load(files("nerg_mi.scenes.store") / "scene.xml", width=48, height=32)
        >>> len(nerg.render(scene, spp=1).plot("depth").axes)
        2
        """
        from .overlay import OverlayLayers, find_overlay, srgb
        from .style import Sheet, figure_of

        drawable = [n for n in ("gaze", COLOR, *self.names) if n in self and (n == COLOR or self[n].ndim == 3)]
        if name is None and drawable:
            name = drawable[0]
        if name is None:
            raise NergError(
                f"{', '.join(self.names)} cannot be drawn as one image; plot one of their channels yourself"
            )
        if name not in self:
            raise NergError(f'the result has no "{name}", only {", ".join(self.names)}; request it with quantities=')
        count, *shape = self[name].shape[:3]
        check_number(observer, Range(-count, count - 1), "observer", is_integer=True)
        color = self[COLOR][observer] if COLOR in self else np.full((*shape, 3), _NO_COLOR, np.float32)
        color = np.repeat(color, 3, axis=-1) if color.shape[-1] == 1 else color
        if name == COLOR:
            page = Sheet([srgb(color)], [""], panels=axes).page
            return show_figure(page) if axes is None else page
        overlay = find_overlay(name)
        mask = self["opacity"][observer] >= SURFACE_OPACITY if "opacity" in self else np.ones(shape, bool)
        layers = OverlayLayers(color, self[name][observer], mask)
        page = figure_of(overlay.draw(layers, overlay.limits(layers), axes=axes))
        return show_figure(page) if axes is None else page

    def _repr_html_(self) -> str | None:
        """The image of the first observer, for notebooks, if it can be drawn."""
        if COLOR not in self and "gaze" not in self:
            return None
        from .style import encode

        note = repr(self).splitlines()[0]
        return markup([image(encode(self.plot(), ".png", {}), note), paragraph(note)])


def render(
    scene: Scene | FilePath,
    observers: ArrayLike | None = None,
    quantities: str | Sequence[str] | None = None,
    *,
    camera: Camera | int | Sensor | None = None,
    spp: int = 0,
    seed: int = 0,
    progress: Progress = None,
) -> Pictures:
    """Render a scene for one or many observers.

    The camera rays are traced once for all observers.

    Parameters
    ----------
    scene : Scene or path
        The scene, or a scene file.
    observers : array_like of shape (M, 3) or (3,), optional
        Positions of the observers whose gaze is computed, in scene units. Default: the observer of the scene, or the
        camera if the scene has no observer.
    quantities : str or sequence of str, optional
        ``"color"`` (linear RGB; luminance in mono variants) and any AOV of the integrator ``nerg``, such as ``depth``
        and ``observer_depth`` (scene units), ``opacity``, ``position``, ``gaze`` (1/sr), ``visibility`` and
        ``support``. Default: ``color``, ``depth``, ``opacity`` and, with a gaze field, ``gaze`` and ``visibility``.
    camera : Camera, int or mi.Sensor, optional
        The camera, or the index of a sensor of the scene. Default: the first sensor.
    spp : int
        Samples per pixel; 0 uses the number of the sensor.
    seed : int
        Equal seeds give equal images. With a box filter, as every `Camera` has, they equal those of ``nerg render`` bit
        by bit.
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.

    Returns
    -------
    Pictures
        The images, with axes (observer, row, column).

    Raises
    ------
    NergError
        An argument is invalid, or the scene cannot compute a quantity.
    KeyboardInterrupt
        Ctrl-C was pressed.

    Examples
    --------
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
    requested = resolve_quantities(scene, quantities)
    sensor = scene.resolve_sensor(camera)
    check_number(spp, Range(0, SPP.high), "spp", is_integer=True)
    check_number(seed, SEEDS, "seed", is_integer=True)
    with open_reporter(progress) as reporter, translate_mitsuba_errors():
        context = make_aov_context(scene, requested)
        positions = _resolve_observers(scene, sensor, observers, bool(context.observer_aovs))
        if context.observer_aovs and (observers is not None or scene.observer is not None):
            warn_extrapolation(reporter, scene, positions)
        layers = _ObserverLayers(context, sensor, requested, positions)
        values = _render_layers(scene, sensor, layers, int(spp), int(seed), reporter)
    return Pictures({name: values[name] for name in requested}, AXES, positions)


def _resolve_observers(scene: Scene, sensor: Any, positions: ArrayLike | None, is_needed: bool) -> Floats:
    """Return the positions (M, 3) of the observers; ``is_needed``: whether the image depends on them."""
    from nerg_mi.transport import observer

    if positions is not None:
        return as_points(positions, "observers")
    if scene.observer is not None:
        return scene.observer[None]
    if is_needed:
        observer.check_centers(sensor)
    return np.array(observer.sensor_center(sensor), np.float32).reshape(1, 3)


class _ObserverLayers:
    """The layers for `nerg_mi.environment.bands.render_bands`: one that all observers share, then one per observer."""

    def __init__(self, context: Any, sensor: Any, requested: Sequence[str], positions: Floats):
        self.sensor, self.color, self.num_observers = sensor, COLOR in requested, len(positions)
        self.recorder: Recorder | None = context.nerg.recorder
        self.context = context
        self.shared, self.per_observer = context.shared_aovs, context.observer_aovs
        self.observer_contexts = (
            [context.make_observer(eye, len(positions) == 1) for eye in positions] if self.per_observer else []
        )
        shared, per_observer = (context.channel_names(names) for names in (self.shared, self.per_observer))
        self.channel_names, self.num_channels = (
            [shared, *(per_observer for _ in self.observer_contexts)],
            len(shared) + len(per_observer),
        )

    def list_inputs(self, scene: Any, num_rays: int) -> list[Any]:
        for observer in self.observer_contexts:
            observer.prepare(self.context, scene, [self.sensor], num_rays)
        return [*self.context.list_inputs(scene, [self.sensor], num_rays), self.observer_contexts]

    def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any, active: Any) -> Iterator[tuple]:
        camera = self.context.trace(scene, [self.sensor], sampler, ray, active)
        shared = camera.compute_channels(self.shared)
        radiance, is_valid, _ = camera.compute_radiance(scene, sampler, medium)
        if self.observer_contexts:
            camera.eval_shared(radiance, is_valid, shared)
        yield radiance, is_valid, shared
        for context in self.observer_contexts:
            yield 0, is_valid, camera.make_pixel(context).compute_channels(self.per_observer)

    def split(self, layer: int, pixels: Floats) -> dict[str, Floats]:
        """Split the channels (height, width, C) of a layer by quantity."""
        alpha = _has_alpha(self.sensor.film())
        first = ([COLOR] if self.color else []) + self.shared
        return split_channels(pixels, self.channel_names[layer], self.per_observer if layer else first, alpha)


def _render_layers(
    scene: Scene, sensor: Any, layers: _ObserverLayers, spp: int, seed: int, reporter: Reporter
) -> dict[str, Floats]:
    """Render all quantities, each with a first axis of observers."""
    from nerg_mi.environment.bands import render_bands
    from nerg_mi.interruption import Interruption

    with Interruption() as stop:

        def on_strip(done: int, total: int) -> None:
            stop.check()
            reporter.progress(done / total, f"{done:,} of {total:,} samples")

        bands = render_bands(scene.mitsuba, sensor, spp=spp, seed=seed, on_strip=on_strip, layers=layers)
        parts = [layers.split(band.layer, np.array(band.film.develop(), np.float32)) for band in bands]
        stop.check()
    common, *each = parts
    values = {name: broadcast_to_observers(value, layers.num_observers) for name, value in common.items()}
    return values | {name: np.stack([one[name] for one in each]) for name in layers.per_observer}


def split_channels(
    pixels: Floats, aov_names: Sequence[str], quantities: Sequence[str], alpha: bool
) -> dict[str, Floats]:
    """Split the channels of an image by quantity.

    Parameters
    ----------
    pixels : ndarray of shape (height, width, C)
        Colour, an alpha channel if ``alpha``, and the AOVs.
    aov_names : sequence of str
        Names of the AOV channels.
    quantities : sequence of str
        Quantities to extract.
    alpha : bool
        Whether there is an alpha channel.

    Returns
    -------
    dict of str to ndarray
        Arrays (height, width) or (height, width, channels).
    """
    first = pixels.shape[-1] - len(aov_names)
    columns: dict[str, list[int]] = {}
    for i, name in enumerate(aov_names):
        columns.setdefault(name.rpartition(".")[0], []).append(first + i)
    out = {}
    for name in quantities:
        if name == COLOR:
            out[name] = np.ascontiguousarray(pixels[..., : first - alpha])
        else:
            channels = columns[name]
            out[name] = np.ascontiguousarray(pixels[..., channels[0]] if len(channels) == 1 else pixels[..., channels])
    return out


def _has_alpha(film: Any) -> bool:
    import mitsuba as mi

    return bool(mi.has_flag(film.flags(), mi.FilmFlags.Alpha))
