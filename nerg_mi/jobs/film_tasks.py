"""Pictures of a film as tasks: what a worker runs for each of them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import find_overlay
from nerg_mi.figures.style import save
from nerg_mi.files.atomic import replacing
from nerg_mi.files.safe_read import read_npy
from nerg_mi.interruption import Interruption
from nerg_mi.rendering.pictures import activate, load_scene
from nerg_mi.rendering.scene_file import files_of_scene
from nerg_mi.tasks.inputs import InputFile
from nerg_mi.threads import use_share

from .options import other_fields
from .options.pictures import PictureOptions
from .overlays import check_memory, layers_of, stacked, style_of, unstacked
from .pictures import render_file, sensor_of

OF_PICTURES = other_fields(PictureOptions, "defaults", "frames", "fps", "threads")
"""The options on which a picture depends, but for the values of a scene's <default>s."""


def make_picture(parameters: Mapping[str, Any], inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """A picture file, as `render_file` writes it. ``parameters``: the ``scene``'s name among ``inputs``, ``options``
    (`OF_PICTURES`) and ``defaults``, in which files are named as inputs: {"input": NAME}."""
    scene, options = _given(parameters, inputs)
    made = render_file(scene, output, options)
    return {"size": made.size, "channels": made.channels, "whole": made.whole, "top": made.top}


def make_layers(parameters: Mapping[str, Any], inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """A picture's colour and overlay as they are before they are drawn (.npy), with what a scale is made of."""
    scene, options = _given(parameters, inputs)
    activate(options.mode)
    overlay = find_overlay(options.overlay or "")
    with Interruption() as stop:
        loaded = load_scene(scene, options.defaults)
        camera = sensor_of(scene, loaded, options.sensor)
        check_memory(scene, camera, options)
        layers = layers_of(scene, loaded, camera, overlay, options.spp, options.seed, lambda *_: stop.check())
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


def draw_layers(parameters: Mapping[str, Any], inputs: Mapping[str, Path], output: Path) -> None:
    """The figure of the layers that `make_layers` made. ``parameters``: ``ends`` of the scale, ``marker``,
    ``supported``, ``basis``, ``options`` of overlays, and what the header says, ``about``."""
    (file,) = inputs.values()
    options, marker, ends = PictureOptions(**parameters["options"]), parameters["marker"], parameters["ends"]
    layers = unstacked(read_npy(file, "layers"), marker and tuple(marker), parameters["supported"], parameters["basis"])
    figure = find_overlay(options.overlay or "").draw(layers, ends and tuple(ends), style_of(options))
    save(figure, output, parameters["about"])


def named_defaults(values: Mapping[str, str], inputs: Iterable[InputFile]) -> dict[str, str | dict[str, str]]:
    """Values of a scene's `<default>`s, with files that they name by a whole path as the ``inputs`` that these are."""
    names = {file.path: file.name for file in inputs}
    given = {k: names.get(os.path.abspath(value)) if os.path.isabs(value) else None for k, value in values.items()}
    return {k: values[k] if name is None else {"input": name} for k, name in given.items()}


def placed_scene(parameters: Mapping[str, Any], inputs: Mapping[str, Path]) -> tuple[Path, dict[str, str]]:
    """The ``scene`` of ``parameters`` and its ``defaults``, with files where they are here. Raises `NergError` for one
    that reads other files than ``inputs``."""
    defaults = {k: v if isinstance(v, str) else str(inputs[v["input"]]) for k, v in parameters["defaults"].items()}
    scene = inputs[parameters["scene"]]
    known = {path.resolve() for path in inputs.values()}
    for file in files_of_scene(scene, defaults):
        if file.resolve() not in known:
            raise NergError(
                f'the scene "{scene.name}" reads "{file}", which is not the file that the job was planned with; name '
                "files relative to the scene, so that workers find the same ones"
            )
    return scene, defaults


def _given(parameters: Mapping[str, Any], inputs: Mapping[str, Path]) -> tuple[Path, PictureOptions]:
    """The scene and its options."""
    use_share()
    options = PictureOptions(**parameters["options"])
    activate(options.mode)
    scene, defaults = placed_scene(parameters, inputs)
    return scene, replace(options, defaults=defaults)
