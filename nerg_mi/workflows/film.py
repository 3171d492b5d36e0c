"""Rendering sequences of pictures, as frames or a video, whole or in parts."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerg_mi.figures.overlay import Limits, find_overlay, shared_limits
from nerg_mi.figures.style import save
from nerg_mi.files.atomic import replacing
from nerg_mi.files.safe_read import read_npy
from nerg_mi.files.video import video_frames
from nerg_mi.interruption import Interruption
from nerg_mi.rendering.scene import activate, load_scene
from nerg_mi.threads import set_thread_count

from .base import SILENT, Reporter
from .options import as_base
from .render import (
    AskedPictures,
    PictureResult,
    account,
    asked_pictures,
    check_memory,
    layers_of,
    provenances,
    render_file,
    sensor_of,
    shares_a_scale,
    stacked,
    style_of,
    unstacked,
)
from .scene_commands import FilmOptions, PictureOptions

if TYPE_CHECKING:
    from .parts import Parts, PlannedScene


_LAYERS_SHARE = 0.8
"""How much of a film with a common scale is rendering; the rest is drawing."""


def render_film(
    scene: str | Path, output: str | Path, options: FilmOptions | None = None, reporter: Reporter = SILENT
) -> PictureResult:
    """Render the scene file ``scene`` to ``output``, as `render_file` does, and to the same bytes.

    With ``options.store`` or ``options.scheduler`` each picture of a sequence is a part, which is kept and not rendered
    again: whatever ended the job, the same call goes on. A picture depends on the scene, on the files that it names, on
    its own values and on the options, and on nothing else: those whose inputs have changed are rendered again. The
    reporter hears the progress of either.
    """
    options = options or FilmOptions()
    if not options.in_parts:
        return render_file(scene, output, options, reporter)
    # A single picture needs neither time nor memory for it.
    from .parts import Parts

    scene, output = Path(scene), Path(output)
    asked = asked_pictures(scene, output, options)
    parts = Parts(options, output, reporter, options.threads)
    reporter.progress(0.0, "reading the scene")
    mode = activate(options.mode)
    if options.threads:
        set_thread_count(options.threads)
    start = time.perf_counter()
    first, top = _rendered(scene, asked, replace(options, mode=mode), parts)
    size, channels = (int(first["size"][0]), int(first["size"][1])), int(first.get("channels", 3))
    seconds = time.perf_counter() - start
    result = PictureResult(asked.files[0], size, channels, mode, seconds, first.get("whole"), tuple(asked.files), top)
    reporter.message(account(result, asked, options))
    reporter.message(f"The parts are kept in {parts.store.folder}; nerg jobs says what they take.")
    return result


def _rendered(
    scene: Path, asked: AskedPictures, options: FilmOptions, parts: Parts
) -> tuple[Mapping[str, Any], float | None]:
    """Make all pictures. Gives the notes of the last, and the upper end of the overlays' scale."""
    from nerg_mi.tasks.task import Part, Plan

    from .parts import PlannedScene

    suffix = ".png" if asked.video else asked.files[0].suffix.lower()
    what = f"nerg render {os.path.abspath(asked.files[0])}"
    of_each = picture_options(options)
    frames = [
        Part(PlannedScene.of(scene, {**(options.defaults or {}), **frame}), f"picture {k + 1}")
        for k, frame in enumerate(asked.frames)
    ]
    overlay = None if options.overlay is None else find_overlay(options.overlay)
    if overlay is None or not shares_a_scale(overlay, len(frames), options):
        last = _write(scene, asked, options, parts, Plan(what, make_picture, of_each, frames, suffix), 0.0)
        return last, last.get("top")
    # All are rendered, then the scale of all is known, and each is drawn by it.
    layers = list(parts.run(Plan(f"{what} (values)", make_layers, of_each, frames, ".npy"), 0.0, _LAYERS_SHARE))
    limits = [None if made.notes["limits"] is None else tuple(made.notes["limits"]) for made in layers]
    ends = shared_limits(limits, options.top)
    overlay.check_limits(ends)
    drawings = []
    for k, (frame, made) in enumerate(zip(asked.frames, layers)):
        header = {}
        if not asked.video:
            header = next(provenances(scene, [frame], options, str(options.mode), False)).text()
        notes = {name: made.notes[name] for name in ("marker", "supported", "basis")}
        drawings.append(Part(LayersToDraw(made.path, ends, **notes, header=header), f"drawing {k + 1}"))
    _write(scene, asked, options, parts, Plan(what, draw_layers, of_each, drawings, suffix), _LAYERS_SHARE)
    return layers[-1].notes, None if ends is None else ends[1]


def _write(
    scene: Path, asked: AskedPictures, options: FilmOptions, parts: Parts, plan: Any, since: float
) -> Mapping[str, Any]:
    """Bring the outputs of ``plan`` to where they belong, one after the other. Gives the notes of the last."""
    last: Mapping[str, Any] = {}
    arriving = parts.run(plan, since)
    if not asked.video:
        for file, made in zip(asked.files, arriving):
            last = made.notes
            with replacing(file) as temporary:
                shutil.copyfile(made.path, temporary)
        return last
    import mitsuba as mi

    headers = provenances(scene, asked.frames, options, str(options.mode), True)
    with video_frames(asked.files[0], options.fps, next(headers).text()) as add:
        for made in arriving:
            last = made.notes
            add(np.array(mi.Bitmap(str(made.path)))[..., :3])
    return last


# ---- Parts ----


def picture_options(options: PictureOptions) -> PictureOptions:
    """The ``options`` of a single picture: a part has the values of its frame itself, and belongs to any video."""
    return replace(as_base(options, PictureOptions), defaults=None, frames=None, fps=PictureOptions().fps)


def make_picture(options: PictureOptions, scene: PlannedScene, output: Path) -> dict[str, Any]:
    """A picture file, as `render_file` writes it."""
    made = render_file(scene.checked(), output, replace(options, defaults=scene.defaults))
    return {"size": made.size, "channels": made.channels, "whole": made.whole, "top": made.top}


def make_layers(options: PictureOptions, scene: PlannedScene, output: Path) -> dict[str, Any]:
    """A picture's colour and overlay as they are before they are drawn (.npy), with what a scale is made of."""
    path = scene.checked()
    activate(options.mode)
    overlay = find_overlay(options.overlay or "")
    with Interruption() as stop:
        loaded = load_scene(path, scene.defaults)
        camera = sensor_of(path, loaded, options.sensor)
        check_memory(path, camera, options)
        layers = layers_of(path, loaded, camera, overlay, options.spp, options.seed, lambda *_: stop.check())
        stop.check()
    with replacing(output) as temporary, temporary.open("wb") as out:
        np.save(out, stacked(layers))
    height, width = layers.mask.shape
    return {
        "size": (width, height),
        "limits": overlay.limits(layers),
        "marker": layers.marker,
        "supported": bool(layers.supported),
        "basis": layers.basis,
    }


@dataclass(frozen=True)
class LayersToDraw:
    """``layers`` (.npy) that `make_layers` made, with its notes; ``ends`` of the scale; ``header`` of the file."""

    layers: Path
    ends: Limits
    marker: Sequence[float] | None
    supported: bool
    basis: str
    header: Mapping[str, str]


def draw_layers(options: PictureOptions, drawing: LayersToDraw, output: Path) -> None:
    """The figure of a picture's layers."""
    marker = None if drawing.marker is None else (drawing.marker[0], drawing.marker[1])
    layers = unstacked(read_npy(drawing.layers, "layers"), marker, drawing.supported, drawing.basis)
    figure = find_overlay(options.overlay or "").draw(layers, drawing.ends, style_of(options))
    save(figure, output, drawing.header)
