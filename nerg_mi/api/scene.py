"""Scenes: a place, whose gaze it is, and from where it is seen."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError, mitsuba_says
from nerg_mi.fields.splats import Splats
from nerg_mi.formats.splats import plugin_of_field
from nerg_mi.registration import plugin_class
from nerg_mi.rendering.aovs import is_nerg
from nerg_mi.rendering.scene_writer import clip_distances
from nerg_mi.transport.geometry import check_shape

from .arrays import Floats, listed, points
from .camera import Camera
from .fields import FilePath, TrainedField
from .options import check_names, file_of
from .shapes import scene_children
from .variant import active_mitsuba

if TYPE_CHECKING:
    import mitsuba as mi

    from nerg_mi.fields.gaze_base import AnyGazeField
    from nerg_mi.fields.radiance import RadianceField
    from nerg_mi.transport.geometry import Place

COLOR = "color"
"""The quantity that is no AOV: linear colour."""


class Scene:
    """A Mitsuba scene whose integrator is ``nerg``: what `render`, `trace`, `observe` and `attention` work on.

    ``mitsuba``: the scene itself, with which everything works that works with Mitsuba's scenes (``mi.traverse``,
    ``mi.render``, ...). ``path``: its file, where it is what that says. `make_scene` makes one of fields;
    ``Scene(scene)`` takes one that is loaded already, and ``Scene.load(path)`` a file. Raises `NergError` for a
    scene with another integrator, and for shapes that are not finite.

    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> scene = nerg.Scene.load(store / "scene.xml", width=48, height=32)
    >>> print(scene.observer)
    [4.4 2.8 1.6]
    """

    def __init__(self, mitsuba: mi.Scene):
        integrator = mitsuba.integrator()
        if not is_nerg(integrator):
            have = "none" if integrator is None else f'"{integrator.class_name()}"'
            raise NergError(
                f'a scene needs the integrator "nerg", and this one has {have}; '
                "make one around its shapes with make_scene(shapes=scene)"
            )
        for shape in mitsuba.shapes():
            check_shape(shape)
        self.mitsuba = mitsuba
        self.path: Path | None = None

    @classmethod
    def load(cls, path: FilePath, **values: object) -> Scene:
        """The scene of an XML file; ``values`` for its `<default>` elements and `$key`, as those of ``nerg render -D``.

        Raises `NergError` for what Mitsuba does not take.
        """
        from nerg_mi.rendering.scene import load_scene

        active_mitsuba()
        # Merged meshes lose their names.
        scene = cls(load_scene(Path(path), {key: str(value) for key, value in values.items()}, merge=False))
        scene.path = None if values else Path(path)
        return scene

    @classmethod
    def of(cls, given: Scene | FilePath | mi.Scene) -> Scene:
        """A scene as a call is given it: one of these, a file of one, or Mitsuba's. Raises `NergError` for anything
        else."""
        if isinstance(given, Scene):
            return given
        if isinstance(given, (str, os.PathLike)):
            return cls.load(given)
        import mitsuba as mi

        active_mitsuba()
        if isinstance(given, mi.Scene):
            return cls(given)
        raise NergError(f"a scene is what make_scene and Scene.load give, or a scene file, got {type(given).__name__}")

    @property
    def integrator(self) -> Any:
        """The scene's integrator."""
        return self.mitsuba.integrator()

    @property
    def place(self) -> Place:
        """What rays of this scene meet: its field or volumes, and its shapes."""
        from nerg_mi.transport.geometry import Place

        return Place(self.integrator.medium, self.mitsuba)

    @property
    def has_gaze(self) -> bool:
        """Whether there is a gaze field."""
        return self.integrator.gaze is not None

    @property
    def observer(self) -> Floats | None:
        """Position (3,) of the scene's own observer; None where the camera is the observer."""
        from nerg_mi.transport.observer import center

        sensor = self.integrator.observer
        return None if sensor is None else np.ravel(np.array(center(sensor), np.float32))

    def set_constant_weights(self, constant: bool = True) -> None:
        """Write the weights of its trained fields into the kernels, for many pictures or rays of one scene: the same
        results to the bit in less time, after some seconds of compilation (the page on performance, "Weights as
        constants"). ``constant`` false takes it back."""
        from nerg_mi.fields.constant_weights import set_constant_weights
        from nerg_mi.rendering.aovs import fields_of

        for trained in fields_of(self.integrator):
            set_constant_weights(trained, constant)

    @property
    def default_quantities(self) -> tuple[str, ...]:
        """What is computed when nothing is asked for by name."""
        return (COLOR, "depth", "opacity", *(("gaze", "visibility") if self.has_gaze else ()))

    def sensor(self, camera: Camera | int | mi.Sensor | None = None) -> mi.Sensor:
        """The sensor that ``camera`` names: a `Camera`, one of the scene's own by its number, or a Mitsuba sensor;
        without any the scene's first. Raises `NergError` where there is none."""
        import mitsuba as mi

        if isinstance(camera, Camera):
            with mitsuba_says():
                return self._fitted(mi.load_dict(camera.to_dict()), camera)
        if isinstance(camera, mi.Sensor):
            return camera
        if not (camera is None or isinstance(camera, (int, np.integer))):
            raise NergError(f"a camera is a Camera, a number or a Mitsuba sensor, got {type(camera).__name__}")
        sensors = self.mitsuba.sensors()
        if not 0 <= (number := camera or 0) < len(sensors):
            have = f"{len(sensors)} of its own" if sensors else "none of its own"
            raise NergError(f"the scene has {have}, and camera {number} was asked for; give camera=Camera(...)")
        return sensors[number]

    def _fitted(self, sensor: mi.Sensor, camera: Camera) -> mi.Sensor:
        """The ``sensor`` of ``camera``, made to see as near and as far as this scene needs."""
        import mitsuba as mi

        params: Any = mi.traverse(sensor)
        near, far = clip_distances(self.place.extent(camera.origin))
        if near < params["near_clip"] or far > params["far_clip"]:
            params["near_clip"], params["far_clip"] = near, far
            params.update()
        return sensor

    def __repr__(self) -> str:
        medium, shapes = self.integrator.medium, len(self.mitsuba.shapes())
        children = self.integrator.children.items()
        files = {name: Path(child.filename).name for name, child in children if hasattr(child, "filename")}
        lines = [f"  {name}: {files[name]}" for name in ("field", "gaze", "kde") if name in files]
        if "field" not in files and medium is not None:
            lines.append("  density: a volume" + (" with colour" if medium.has_color else ""))
        lines += [f"  shapes: {shapes}"] if shapes else []
        lines.append(f"  observer: {'the camera' if self.observer is None else _written(self.observer)}")
        for i, sensor in enumerate(self.mitsuba.sensors()):
            width, height = sensor.film().crop_size()
            lines.append(f"  camera {i}: {width} x {height} pixels")
        return "\n".join(["Scene", *lines])


def make_scene(
    field: FilePath | TrainedField[RadianceField] | RadianceField | Splats | None = None,
    gaze: FilePath | TrainedField[AnyGazeField] | AnyGazeField | None = None,
    *,
    shapes: object = None,
    camera: Camera | Mapping[str, Any] | mi.Sensor | None = None,
    observer: ArrayLike | None = None,
    to_world: ArrayLike | None = None,
    **settings: Any,
) -> Scene:
    """A scene of a trained place, a gaze field, or shapes, without writing XML.

    ``field``, ``gaze``: what `load_field`, `load_gaze` or a training gave, or the name of a checkpoint; a place may be
    Gaussian splats, too: a file of them, or what `nerg_mi.formats.splats.read_splats` gave. ``shapes``: what
    stands in the field, or is all there is: a mesh file (.ply, .obj, .glb), a scene file, a dict for ``mi.load_dict``,
    a Mitsuba scene or shape, or several of these in a list or a dict by name. ``camera``: a `Camera`, or a sensor as
    Mitsuba takes it. ``observer``: position (3,) of the one whose gaze it is; without it the camera is the observer.
    ``to_world``: (4, 4) rotation, uniform scale and translation that place both fields in the scene. ``settings``:
    parameters of the integrator ``nerg`` (``falloff=0.3``, ``visibility="map"``, ``density={"type": ...}``,
    ``kde={"type": "gazekde", "filename": "day.npz"}``, ...); its docstring is their manual. Raises `NergError`.

    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> camera = nerg.Camera(origin=(7.4, 3.4, 2.2), target=(4.8, 4.2, 1.0), fov=78, width=48, height=32)
    >>> scene = nerg.make_scene(store / "store.safetensors", store / "shoppers.safetensors", camera=camera)
    >>> scene
    Scene
      field: store.safetensors
      gaze: shoppers.safetensors
      observer: the camera
      camera 0: 48 x 32 pixels
    """
    import mitsuba as mi

    active_mitsuba()
    # Objects may be nested by any name.
    check_names("make_scene", (k for k, v in settings.items() if isinstance(v, _PLAIN)), _parameters(), "setting")
    integrator: dict[str, Any] = {"type": "nerg", **settings}
    where = None if to_world is None else _transform(to_world)
    if field is not None:
        integrator["field"] = _volume(field, "field", where)
    if gaze is not None:
        integrator["gaze"] = _volume(gaze, "gaze", where)
    if observer is not None:
        position = points(observer, "the observer")
        if len(position) != 1:
            raise NergError("a scene has one observer; give render, observe or attention the others")
        integrator["observer"] = _observer_sensor(position[0])
    integrator.setdefault("aovs", ",".join(["depth", "opacity", *(["gaze", "visibility"] if gaze is not None else [])]))
    children = scene_children(shapes)
    if not children and integrator.keys().isdisjoint({"field", "density"}):
        raise NergError("there is nothing to see in this scene; give make_scene a field or shapes")
    if camera is not None:
        children["camera"] = camera.to_dict() if isinstance(camera, Camera) else camera
    with mitsuba_says():
        # Merged meshes lose their names.
        scene = Scene(mi.load_dict({"type": "scene", "integrator": integrator, **children}, optimize=False))
    if isinstance(camera, Camera):
        scene._fitted(next(s for s in scene.mitsuba.sensors() if s.id() == "camera"), camera)
    return scene


_PLAIN = (str, bool, int, float, np.number)


def _parameters() -> list[str]:
    """The parameters of the integrator ``nerg``, which its manual lists."""
    manual = sys.modules[plugin_class("nerg").__module__].__doc__ or ""
    rows = re.findall(r"^ \* - ([a-z_]+(?:, [a-z_]+)*)$", manual, re.MULTILINE)
    return [name for row in rows for name in row.split(", ")]


def _observer_sensor(position: ArrayLike) -> dict:
    """An observer at ``position`` (3,) as the integrator takes it: a sensor of which only the centre counts."""
    import mitsuba as mi

    place = mi.ScalarTransform4d().translate(np.asarray(position, np.float64).tolist())
    return {"type": "perspective", "to_world": place, "film": {"type": "hdrfilm", "width": 1, "height": 1}}


def context_for(scene: Scene, quantities: Sequence[str]) -> Any:
    """What ``quantities`` of the scene are computed with; the ``own`` depend on the observer, the ``shared`` do not.

    Raises `NergError` for those that it cannot compute.
    """
    return scene.integrator.for_aovs([name for name in quantities if name != COLOR], COLOR in quantities)


def asked_quantities(scene: Scene, names: object, known: tuple[str, ...] | None = None) -> tuple[str, ...]:
    """The quantities ``names`` (a name, several, or None for the scene's own choice), each once.

    ``known``: those that may be asked for; None leaves it to the integrator to say. Raises `NergError`.
    """
    if names is None:
        chosen = scene.default_quantities
        return tuple(name for name in chosen if known is None or name in known)
    given = [names] if isinstance(names, str) else list(names) if isinstance(names, (list, tuple)) else None
    if not given or not all(isinstance(name, str) for name in given):
        raise NergError(f'quantities are names such as "depth", got {names!r}')
    for name in given:
        if known is not None and name not in known:
            raise NergError(f'there is no quantity "{name}" here; there are {listed(known)}')
    return tuple(dict.fromkeys(given))


def _volume(given: object, role: str, to_world: Any) -> Any:
    """The volume of a field, which is a file or in memory, for the integrator's property ``role``."""
    plugin = {"field": "splats" if isinstance(given, Splats) else "nerf", "gaze": "gazefield"}[role]
    if isinstance(given, (str, os.PathLike)):
        given = file_of(given, role)
        plugin = plugin_of_field(given) if role == "field" else plugin
        where = {} if to_world is None else {"to_world": to_world}
        return {"type": plugin, "filename": os.path.abspath(given), **where}
    volume = plugin_class(plugin)
    if isinstance(given, TrainedField):
        return volume.of(given.network, to_world, given.name)
    return volume.of(given, to_world)


def _transform(matrix: ArrayLike) -> Any:
    import mitsuba as mi

    from nerg_mi.maths.geometry import Similarity

    matrix = np.array(getattr(matrix, "matrix", matrix), np.float64)
    if matrix.shape != (4, 4):
        raise NergError(f'"to_world" must have 4 x 4 numbers, got the shape {matrix.shape}')
    return mi.ScalarTransform4d(Similarity(matrix).matrix)


def _written(position: Floats) -> str:
    return f"({', '.join(f'{x:.4g}' for x in position)})"
