"""From a scene file to pictures or a video in parts that are kept, and that others may make."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.figures.overlay import find_overlay, shared_limits
from nerg_mi.files.atomic import replacing
from nerg_mi.files.video import video_frames
from nerg_mi.rendering.pictures import activate
from nerg_mi.rendering.scene_file import files_of_scene
from nerg_mi.tasks.code import RENDERS, versions
from nerg_mi.tasks.inputs import Checksums, name_of, read_input, read_inputs
from nerg_mi.tasks.plan import Plan
from nerg_mi.tasks.run import Output
from nerg_mi.tasks.task import Task
from nerg_mi.threads import set_thread_count

from .film_tasks import OF_PICTURES, draw_layers, make_layers, make_picture, named_defaults
from .options.parts import FilmOptions
from .overlays import shares_a_scale
from .parts import Parts
from .pictures import AskedPictures, PictureResult, account, asked_pictures, provenances
from .reporter import Reporter

_LAYERS_SHARE = 0.8
"""How much of a film with a common scale is rendering; the rest is drawing."""


def render_parts(scene: Path, output: Path, options: FilmOptions, reporter: Reporter) -> PictureResult:
    """Render the scene file ``scene`` to ``output``, each picture a part; see `film.render_film`."""
    asked = asked_pictures(scene, output, options)
    parts = Parts(options, output, reporter, options.threads)
    reporter.progress(0.0, "reading the scene")
    mode = activate(options.mode)
    if options.threads:
        set_thread_count(options.threads)
    start = time.perf_counter()
    film = _Film(scene, asked, replace(options, mode=mode), parts)
    first, top = film.with_one_scale() if film.waits else film.one_by_one()
    size, channels = (int(first["size"][0]), int(first["size"][1])), int(first.get("channels", 3))
    seconds = time.perf_counter() - start
    result = PictureResult(asked.files[0], size, channels, mode, seconds, first.get("whole"), tuple(asked.files), top)
    reporter.message(account(result, asked, options))
    reporter.message(f"The parts are kept in {parts.store.folder}; nerg jobs says what they take.")
    return result


class _Film:
    """One film: its tasks, and what becomes of their outputs."""

    def __init__(self, scene: Path, asked: AskedPictures, options: FilmOptions, parts: Parts):
        self.scene, self.asked, self.options, self.parts = scene, asked, options, parts
        self.overlay = None if options.overlay is None else find_overlay(options.overlay)
        self.waits = self.overlay is not None and shares_a_scale(self.overlay, len(asked.frames), options)
        self.suffix = ".png" if asked.video else asked.files[0].suffix.lower()
        self.what = f"nerg render {os.path.abspath(asked.files[0])}"
        self.versions = versions(*RENDERS)
        self.checksums = Checksums()
        self.chosen = {name: getattr(options, name) for name in OF_PICTURES}

    def one_by_one(self) -> tuple[Mapping[str, Any], float | None]:
        """Write each picture as it is there. Gives the notes of the last, and the upper end of the overlays' scale."""
        tasks = [self._task(make_picture, k, frame, self.suffix) for k, frame in enumerate(self.asked.frames)]
        last = self._write(Plan(self.what, tasks), 0.0)
        return last, last.get("top")

    def with_one_scale(self) -> tuple[Mapping[str, Any], float | None]:
        """Render all, find the scale of all, and draw each by it."""
        assert self.overlay is not None
        tasks = [self._task(make_layers, k, frame, ".npy") for k, frame in enumerate(self.asked.frames)]
        layers = list(self.parts.run(Plan(f"{self.what} (values)", tasks), 0.0, _LAYERS_SHARE))
        limits = [None if made.notes["limits"] is None else tuple(made.notes["limits"]) for made in layers]
        ends = shared_limits(limits, self.options.top)
        self.overlay.check_limits(ends)
        plan = Plan(self.what, [self._drawing(k, made, ends) for k, made in enumerate(layers)])
        self._write(plan, _LAYERS_SHARE)
        return layers[-1].notes, None if ends is None else ends[1]

    def _task(self, function: Any, k: int, frame: Mapping[str, str], suffix: str) -> Task:
        values = {**(self.options.defaults or {}), **frame}
        inputs = read_inputs(files_of_scene(self.scene, values), self.checksums)
        parameters = {
            "scene": name_of(self.scene, inputs),
            "options": self.chosen,
            "defaults": named_defaults(values, inputs),
        }
        return Task(_name(function), parameters, inputs, suffix, self.versions, f"picture {k + 1}")

    def _drawing(self, k: int, made: Output, ends: tuple[float, float] | None) -> Task:
        about = {}
        if not self.asked.video:
            frame = [self.asked.frames[k]]
            about = next(provenances(self.scene, frame, self.options, str(self.options.mode), False)).text()
        parameters = {
            "ends": ends,
            "marker": made.notes["marker"],
            "supported": made.notes["supported"],
            "basis": made.notes["basis"],
            "options": self.chosen,
            "about": about,
        }
        inputs = (read_input("layers.npy", made.path, self.checksums),)
        return Task(_name(draw_layers), parameters, inputs, self.suffix, self.versions, f"drawing {k + 1}")

    def _write(self, plan: Plan, since: float) -> Mapping[str, Any]:
        """Bring the outputs of ``plan`` to where they belong, one after the other. Gives the notes of the last."""
        last: Mapping[str, Any] = {}
        arriving = self.parts.run(plan, since)
        if not self.asked.video:
            for file, made in zip(self.asked.files, arriving):
                last = made.notes
                with replacing(file) as temporary:
                    shutil.copyfile(made.path, temporary)
            return last
        given = provenances(self.scene, self.asked.frames, self.options, str(self.options.mode), True)
        with video_frames(self.asked.files[0], self.options.fps, next(given).text()) as add:
            for made in arriving:
                last = made.notes
                add(_pixels(made.path))
        return last


def _pixels(path: Path) -> np.ndarray:
    """Display values (h, w, 3) of uint8 of a PNG file that a part made."""
    import mitsuba as mi

    return np.array(mi.Bitmap(str(path)))[..., :3]


def _name(function: Any) -> str:
    return f"{function.__module__}:{function.__name__}"
