"""Images of Mitsuba scenes as tensors, like those of ``mi.render``, but replayed."""

from __future__ import annotations

import warnings

from nerg_mi.errors import translate_mitsuba_errors
from nerg_mi.maths.types import MitsubaScene, Sensor, Tensor
from nerg_mi.ranges import SEEDS, SPP, Range, check_number

from .arrays import Camera
from .bands import render_bands, undividable_reason
from .scene import Scene


def render_tensor(
    scene: Scene | MitsubaScene, sensor: Camera | int | Sensor = 0, *, spp: int = 0, seed: int = 0
) -> Tensor:
    """Render an image with the integrator `nerg` as a tensor: ``mi.render`` for many images.

    The first image of a structure is traced, as by ``mi.render``; the second one is recorded, and further ones are
    replayed, which takes a tenth of the time for small images. A structure is the size of the film, the samples per
    pixel, the AOVs, the settings of the integrator, and the objects of the scene. Cameras, observers, seeds, fall-off,
    weights, shapes, materials and lights may change between images, by ``mi.traverse`` or otherwise.

    Parameters
    ----------
    scene : Scene or mi.Scene
        The scene; its integrator is `nerg`.
    sensor : Camera, int or mi.Sensor
        The camera, or the index of a sensor of the scene.
    spp : int
        Samples per pixel; 0 uses the number of the sensor.
    seed : int
        Equal seeds give equal images.

    Returns
    -------
    mi.TensorXf
        The image (height, width, channels), without derivatives. With a box filter it equals that of ``mi.render`` bit
        by bit.

    Raises
    ------
    NergError
        An argument is invalid, or the scene cannot be rendered.

    Warns
    -----
    UserWarning
        Once for each scene that cannot be recorded, with the reason: derivatives, a sensor or sampler
        of another kind, or a plugin that Dr.Jit cannot record. Its images are traced.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> import mitsuba as mi
    >>> scene = mi.load_file(str(files("nerg_mi.scenes.store") / "scene.xml"), width=48, height=32)
    >>> images = [nerg.render_tensor(scene, spp=1, seed=number) for number in range(4)]
    >>> images[3].shape
    (32, 48, 7)
    """
    scene = Scene.coerce(scene)
    camera = scene.resolve_sensor(sensor)
    check_number(spp, Range(0, SPP.high), "spp", is_integer=True)
    check_number(seed, SEEDS, "seed", is_integer=True)
    recorder = scene.integrator.recorder
    recorder.reason = undividable_reason(scene.mitsuba, camera) or ""
    with translate_mitsuba_errors():
        (band,) = render_bands(scene.mitsuba, camera, spp=int(spp), seed=int(seed))
    if reason := recorder.take_reason():
        warnings.warn(f"images of this scene are traced and not replayed, because of {reason}", stacklevel=2)
    return band.film.develop()
