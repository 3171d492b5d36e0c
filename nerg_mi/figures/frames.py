"""Frames of a film: how they are rendered, and the pictures that are written to files or a video."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from nerg_mi.environment import bands
from nerg_mi.environment.bands import ConstantWeightsTrial, SamplePace
from nerg_mi.environment.rendering_files import DisplayRows, open_image_rows
from nerg_mi.environment.scene_sequence import SceneSequence
from nerg_mi.environment.sensors import describe_observer
from nerg_mi.errors import NergError, parameter, sanitize, translate_mitsuba_errors
from nerg_mi.files.atomic import replace_atomically
from nerg_mi.files.safe_read import read_npy
from nerg_mi.interruption import Interruption
from nerg_mi.progress import Reporter

from .layers import describe_bases, render_layers
from .overlay import OverlayLayers, find_overlay
from .settings import SMOOTHING
from .style import Provenance, make_provenance, rasterize, save

BYTES_PER_PIXEL = 400
"""Maximum memory per pixel for drawing an overlay: matplotlib stores colours in double precision."""

RESERVE = 150e6
"""Bytes reserved in addition to a band: for its strips and the first kernel compilation."""

MIN_BAND_BYTES = 16e6
"""Bytes of a band, even if there is less memory: smaller ones save little and take longer."""

Frame = Mapping[str, str]
"""Values of `<default>`s of a scene file."""

# ---- What is rendered ----


@dataclass(frozen=True)
class FrameSettings:
    """What the pictures of a film depend on, besides the scene (`render_film`)."""

    mode: str
    sensor: int = 0
    spp: int = 0
    seed: int = 0
    memory: float = 1.0
    overlay: str | None = None
    smoothing: float = SMOOTHING


class FilmProvenance:
    """Makes the provenance of pictures: ``recorded`` settings in addition to those of rendering."""

    def __init__(self, scene: SceneSequence, settings: FrameSettings, recorded: Mapping[str, Any] | None = None):
        self._scene, self._settings, self._checksums = scene, settings, dict[Path, str]()
        self._recorded = {"mode": settings.mode, "sensor": settings.sensor, "spp": settings.spp, **(recorded or {})}

    def make(self, frame: Frame) -> Provenance:
        """Return the provenance of the picture of a frame."""
        return self._make(self._scene.list_files(frame), {"defaults": {**self._scene.values, **frame}})

    def make_video(self, first: Frame, more_files: Sequence[Path], fps: float) -> Provenance:
        """Return the provenance of a video."""
        files = [*self._scene.list_files(first), *more_files]
        return self._make(files, {"defaults": self._scene.values, "fps": fps})

    def _make(self, files: Iterable[Path], more: Mapping[str, Any]) -> Provenance:
        return make_provenance("nerg render", files, self._settings.seed, {**self._recorded, **more}, self._checksums)


# ---- Pictures ----


class Picture(Protocol):
    """A picture of a film."""

    def save(self, path: Path) -> None:
        """Write the picture to a file."""

    def pixels(self) -> np.ndarray:
        """Return the picture (height, width, 3) for a video, uint8."""
        ...


class RenderedPicture:
    """An image with the channels of the scene's integrator, rendered band by band while it is written.

    Parameters
    ----------
    size
        Width and height in pixels.
    rows
        Yields a bitmap, and how many of its rows continue the image, for each band.
    make_header
        Returns the texts of the file header.
    """

    def __init__(
        self, size: tuple[int, int], rows: Iterator[tuple[Any, int]], make_header: Callable[[], Mapping[str, str]]
    ):
        self._size, self._rows, self._make_header = size, rows, make_header

    def save(self, path: Path) -> None:
        with open_image_rows(path, *self._size, self._make_header()) as add:
            self._render(add)

    def pixels(self) -> np.ndarray:
        display = DisplayRows(*self._size)
        self._render(display.add)
        return display.pixels()

    def _render(self, add: Callable[[Any, int], None]) -> None:
        with translate_mitsuba_errors():
            for bitmap, rows in self._rows:
                add(bitmap, rows)


@dataclass(frozen=True)
class DrawnPicture:
    """A ``figure``; ``make_header`` returns the texts of its file header."""

    figure: Any
    make_header: Callable[[], Mapping[str, str]]

    def save(self, path: Path) -> None:
        save(self.figure, path, self.make_header())

    def pixels(self) -> np.ndarray:
        return rasterize(self.figure)


@dataclass(frozen=True)
class StoredPicture:
    """A finished image ``file``."""

    file: Path

    def save(self, path: Path) -> None:
        with replace_atomically(path) as temporary:
            shutil.copyfile(self.file, temporary)

    def pixels(self) -> np.ndarray:
        import mitsuba as mi

        return np.array(mi.Bitmap(str(self.file)))[..., :3]


@dataclass(frozen=True)
class StoredLayers:
    """Layers of an overlay in a ``file`` (.npy), which are drawn when the colour scale is known.

    The array (h, w, 5) has the channels linear red, green and blue, the values, and the mask. The other attributes are
    those of `OverlayLayers`.
    """

    file: Path
    marker: Sequence[float] | None
    has_support: bool
    support_note: str

    @classmethod
    def store(cls, file: Path, layers: OverlayLayers) -> StoredLayers:
        """Write ``layers`` to a file."""
        array = np.concatenate([layers.color, layers.values[..., None], layers.mask[..., None]], axis=-1)
        with replace_atomically(file) as temporary, temporary.open("wb") as out:
            np.save(out, np.ascontiguousarray(array, np.float32))
        return cls(file, layers.marker, bool(layers.has_support), layers.support_note)

    def read(self) -> OverlayLayers:
        """Read the layers."""
        array = read_npy(self.file, "layers")
        color, values, mask = array[..., :3], array[..., 3], array[..., 4] > 0.5
        marker = None if self.marker is None else (self.marker[0], self.marker[1])
        return OverlayLayers(color, values, mask, marker, self.has_support, self.support_note)


# ---- Rendering ----


class FrameRenderer:
    """Renders the frames of a film, one after the other.

    ``size`` (width, height) and number of ``channels`` are those of the last image, and ``undivided_reason`` tells why
    it was not rendered in bands although it exceeded the memory limit. ``observer_note`` tells why the gaze of the
    observer is extrapolated in the first picture where it is, of which the ``reporter`` is warned; "" if it is not.
    """

    def __init__(
        self, scene: SceneSequence, settings: FrameSettings, num_frames: int, reporter: Reporter, stop: Interruption
    ):
        self.size, self.channels, self.undivided_reason, self.observer_note = (0, 0), 3, None, ""
        self._scene, self._settings, self._num_frames = scene, settings, num_frames
        self._reporter, self._stop = reporter, stop
        self._start, self._num_done = time.perf_counter(), 0
        self._pace, self._trial = SamplePace(), ConstantWeightsTrial(num_frames)

    def render(self, frame: Frame, provenance: FilmProvenance) -> RenderedPicture:
        """Return the image of a frame, which is rendered while it is written."""
        loaded, camera = self._load(frame)
        free = 1e9 * self._settings.memory - resident_bytes() - RESERVE
        fit = lambda memory: bands.fit_rows_to_memory(loaded, camera, memory)
        self.undivided_reason = bands.undividable_reason(loaded, camera) if fit(free) < self.size[1] else None
        rows = fit(max(free, MIN_BAND_BYTES))
        make_header = lambda: provenance.make(frame).text() | describe_bases(loaded)
        return RenderedPicture(self.size, self._render_bands(loaded, camera, rows), make_header)

    def _render_bands(self, loaded: Any, camera: Any, rows: int) -> Iterator[tuple[Any, int]]:
        spp, seed = self._settings.spp, self._settings.seed
        samples, begin = count_samples(camera, spp), time.perf_counter()
        is_constant = self._trial.prepare(samples, loaded)
        for band in bands.render_bands(
            loaded, camera, spp=spp, seed=seed, rows=rows, on_strip=self._report, pace=self._pace
        ):
            bitmap = band.film.bitmap()
            self.channels = bitmap.channel_count()
            yield bitmap, band.rows
            self._stop.check()
        self._trial.record(is_constant, samples, time.perf_counter() - begin)
        self._num_done += 1

    def render_layers(self, frame: Frame) -> OverlayLayers:
        """Render the layers of the overlay of a frame. Raises `NergError` if drawing them exceeds the memory limit."""
        s = self._settings
        loaded, camera = self._load(frame)
        check_memory(self._scene.path, camera, s.memory)
        samples, begin = count_samples(camera, s.spp), time.perf_counter()
        is_constant = self._trial.prepare(samples, loaded)
        overlay = find_overlay(s.overlay or "")
        layers = render_layers(self._scene.path, loaded, camera, overlay, s.spp, s.seed, self._report, s.smoothing)
        self._trial.record(is_constant, samples, time.perf_counter() - begin)
        self._num_done += 1
        return layers

    def _load(self, frame: Frame) -> tuple[Any, Any]:
        """Return the scene of a frame and the sensor."""
        loaded = self._scene.load(frame)
        self._stop.check()
        for name in self._scene.unknown_objects:
            self._reporter.warn(
                f"{name_picture(self._num_done, self._num_frames)}the pose of the object "
                f'"{sanitize(name, 40)}" is unknown then, and it is left out'
            )
        if not self.observer_note and (note := describe_observer(loaded)):
            self.observer_note = note
            self._reporter.warn(name_picture(self._num_done, self._num_frames) + note)
        camera = find_sensor(self._scene.path, loaded, self._settings.sensor)
        width, height = map(int, camera.film().crop_size())
        self.size = width, height
        return loaded, camera

    def _report(self, part: int, total: int) -> None:
        self._stop.check()
        fraction = (self._num_done + part / total) / self._num_frames
        seconds = max(time.perf_counter() - self._start, 1e-9)
        speed = f"{part / seconds:,.0f} samples/s"
        if self._num_frames > 1:
            speed = f"{self._num_done} of {self._num_frames} pictures"
        left = f"{seconds * (1 - fraction) / fraction:.0f} s left"
        ending = "writing" if self._settings.overlay is None else "drawing the overlay"
        self._reporter.progress(fraction, f"rendering, {speed}, {left}" if fraction < 1 else ending)


def name_picture(index: int, count: int) -> str:
    """Return the beginning of a sentence on one picture of a sequence."""
    return f"picture {index + 1}: " if count > 1 else ""


def check_memory(path: Path, camera: Any, memory: float) -> None:
    """Raise `NergError` if drawing an overlay exceeds ``memory`` in GB."""
    width, height = map(int, camera.film().crop_size())
    needed = BYTES_PER_PIXEL * width * height / 1e9
    if needed > memory:
        raise NergError(
            f"drawing an overlay of {width:,} x {height:,} pixels needs {needed:.2g} GB; increase "
            f'{parameter("memory")} to {needed:.1f}, or reduce the size of "{path}"'
        )


def find_sensor(path: Path, scene: Any, index: int) -> Any:
    """Return the sensor with this ``index``. Raises `NergError` if there is none, or no integrator."""
    if scene.integrator() is None:
        raise NergError(f'the scene "{path}" has no integrator; add one, such as <integrator type="nerg"/>')
    count = len(scene.sensors())
    if not 0 <= index < count:
        raise NergError(
            f'"{path}" has {count} sensor(s), and {parameter("sensor", index)} is out of range; it counts from 0'
        )
    return scene.sensors()[index]


def count_samples(camera: Any, spp: int) -> int:
    """Return the number of samples of an image: ``spp`` per pixel, or that of the sampler if it is 0."""
    width, height = map(int, camera.film().crop_size())
    return width * height * (spp or camera.sampler().sample_count())


def resident_bytes() -> int:
    """Return the resident memory of this process in bytes, or its maximum where the system does not report it."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        import resource
        import sys

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
