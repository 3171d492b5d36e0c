"""Scenes with the integrator ``nerg``: loading, construction without XML, saving, quantities and cameras."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import MissingFile, NergError, sanitize, translate_mitsuba_errors
from nerg_mi.fields.gaze_base import GazeNetwork
from nerg_mi.fields.splats import Splats
from nerg_mi.files.atomic import check_writable, write_text
from nerg_mi.files.html import key_value_table
from nerg_mi.files.values import FilePath, to_numbers
from nerg_mi.formats.alignments import AnySimilarity, open_similarity
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.types import Axes, Figure, MitsubaScene, Sensor, Unpack
from nerg_mi.progress import Progress, WarningReporter
from nerg_mi.tracking.objects import ObjectPoses
from nerg_mi.transport.geometry import SceneGeometry, check_shape
from nerg_mi.transport.observer import ObserverSettings

from .arrays import Camera, Floats, as_points, join_names
from .bands import is_nerg
from .contents import (
    DensityGrid,
    FieldVolume,
    GridVolume,
    find_tag,
    has_nerg,
    load_content,
    to_scene_children,
    write_content,
)
from .hits import NO_DATA_GREY, read_hit_volume, shade_hits
from .integrator_settings import IntegratorSettings, check_settings
from .kinds import ROLES, detect_kind
from .moments import Moment, ShapeMover
from .nested_scene import SceneDocument
from .scene_loading import activate_mitsuba, check_sensor, load_scene
from .scene_writer import compute_clip_distances
from .trained import TrainedField

COLOR = "color"
"""Name of the linear colour, the only quantity that is not an AOV."""


@dataclass(frozen=True)
class ObserverSpace:
    """What observers see, and how their rays are traced: the geometry, the settings, and the similarity from the frame
    of the gaze field to that of the geometry."""

    geometry: SceneGeometry
    settings: ObserverSettings
    to_world: Similarity


class Scene:
    """A Mitsuba scene with the integrator ``nerg``, for `render`, `trace`, `observe` and `attention`.

    `make_scene` makes a scene from fields, ``Scene(scene)`` wraps a loaded Mitsuba scene, and ``Scene.load(path)``
    loads a file.

    Parameters
    ----------
    mitsuba : mi.Scene
        The scene.

    Attributes
    ----------
    mitsuba : mi.Scene
        The scene, for ``mi.traverse``, ``mi.render`` and other functions of Mitsuba.
    path : Path or None
        The scene file, if the scene is its unchanged content.
    source : tuple of Path and dict, or None
        The file that the scene was loaded from, and the values of its ``<default>`` elements.

    Raises
    ------
    NergError
        The scene has another integrator, or the vertices of a shape are not finite.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> scene = nerg.Scene.load(store / "scene.xml", width=48, height=32)
    >>> print(scene.observer)
    [4.4 2.8 1.6]
    """

    def __init__(self, mitsuba: MitsubaScene):
        if type(mitsuba).__name__ != "Scene":
            raise NergError(
                f'a scene must be a Mitsuba scene, not a {type(mitsuba).__name__}; use {{"type": "scene", ...}}'
            )
        integrator: Any = mitsuba.integrator()
        if not is_nerg(integrator):
            have = "none" if integrator is None else f'"{integrator.class_name()}"'
            raise NergError(
                f'a scene needs the integrator "nerg", but this one has {have}; '
                "use make_scene(shapes=scene) to make a scene with its shapes"
            )
        self.mitsuba, self.variant = mitsuba, integrator.variant
        self.check_variant()
        for shape in mitsuba.shapes():
            check_shape(shape)
        for index, sensor in enumerate(mitsuba.sensors()):
            check_sensor(sensor, f"the to_world of sensor {index}")
        self.path: Path | None = None
        self._content: dict[str, Any] | None = None
        self.source: tuple[Path, dict[str, str]] | None = None
        self._mover: ShapeMover | None = None

    @classmethod
    def load(cls, path: FilePath, **values: object) -> Scene:
        """Load a scene file.

        Parameters
        ----------
        path : path
            XML file.
        **values
            Values of its `<default>`s and `$key`s, as for ``nerg render -D``.

        Returns
        -------
        Scene
            The scene.

        Raises
        ------
        NergError
            Mitsuba rejects the scene, or its integrator is not ``nerg``.
        """
        activate_mitsuba()
        texts = {key: str(value) for key, value in values.items()}
        # Merged meshes would lose their names.
        scene = cls(load_scene(Path(path), texts, merge=False))
        scene.path = None if values else Path(path)
        scene.source = Path(path), texts
        return scene

    def check_variant(self) -> None:
        """Raise `NergError` if another Mitsuba variant than that of the scene is active."""
        import mitsuba as mi

        activate_mitsuba()
        if mi.variant() != self.variant:
            raise NergError(
                f'the scene belongs to the Mitsuba variant "{self.variant}", but "{mi.variant()}" is active; call '
                f'mi.set_variant("{self.variant}"), or load the scene again'
            )

    @classmethod
    def coerce(cls, scene: Scene | FilePath | MitsubaScene | Mapping[str, Any]) -> Scene:
        """Return ``scene`` as a `Scene`: a scene file or a dict is loaded, and a Mitsuba scene is wrapped.

        Raises `NergError`.
        """
        if isinstance(scene, Scene):
            scene.check_variant()
            return scene
        if isinstance(scene, (str, os.PathLike)):
            return cls.load(Path(scene))
        activate_mitsuba()
        # Each variant has a class of this name.
        if type(scene).__name__ == "Scene" and type(scene).__module__.partition(".")[0] == "mitsuba":
            return cls(cast("MitsubaScene", scene))
        if isinstance(scene, Mapping):
            return cls._from_content(dict(scene))
        raise NergError(
            f"a scene must be a Scene, a Mitsuba scene, a dict of one or a scene file, got {type(scene).__name__}; "
            "make_scene makes a scene of fields and meshes"
        )

    @classmethod
    def _from_content(cls, content: dict[str, Any]) -> Scene:
        """Make a scene of its content (`nerg_mi.environment.contents`)."""
        scene = cls(load_content(content))
        scene._content = content
        return scene

    def save(self, path: FilePath) -> Path:
        """Write a scene file (.xml) atomically.

        Fields, grids and splats that have no file are written next to it, in files whose names begin with that of the
        scene, and meshes in the folder ``NAME.meshes``. Of a scene that ``Scene(scene)`` wraps, only meshes can be
        written, in grey; make the scene with `make_scene` to write all of it.

        Parameters
        ----------
        path : path
            File to write.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        NergError
            The scene contains an object of Mitsuba that cannot be written, or a file cannot be written.

        Examples
        --------
        >>> import nerg_mi as nerg, trimesh
        >>> room = trimesh.creation.box((4, 3, 2.5))
        >>> scene = nerg.make_scene(room, camera=nerg.Camera((0, 0, 0), (1, 0, 0), width=9, height=6))
        >>> nerg.Scene.load(scene.save(folder / "room.xml"))
        Scene
          shapes: 1
          observer: the camera
          camera 0: 9 x 6 pixels
        """
        path = Path(path)
        check_writable(path, ".xml")
        if self.source is not None:
            write_text(path, SceneDocument.read(*self.source).to_xml())
            return path
        if self._content is None:
            aovs = ",".join(self.integrator.aov_names()) and "depth,opacity"
            if self.integrator.medium is not None or self.integrator.gaze is not None:
                raise NergError(
                    "the scene was made by Mitsuba in memory, and its fields cannot be written to a file; make it with "
                    "make_scene, or load it from a file or a dict"
                )
            content = {"type": "scene", "integrator": {"type": "nerg", "aovs": aovs}, **to_scene_children(self.mitsuba)}
        else:
            content = self._content
        write_content(path, content, "A scene made by nerg_mi in Python.")
        return path

    def show(
        self,
        quantity: str | None = None,
        *,
        observer: ArrayLike | None = None,
        axes: Axes | None = None,
        spp: int = 16,
        camera: Camera | int | Sensor | None = None,
        seed: int = 0,
        progress: Progress = None,
    ) -> Figure:
        """Render the scene as a figure: its colour, with a quantity over it.

        Parameters
        ----------
        quantity : str, optional
            An AOV such as ``gaze``, ``depth`` or ``visibility``. Default: ``gaze`` if the scene has a gaze field.
        observer : array_like of shape (3,), optional
            Position of the observer. Default: as for `render`.
        axes : matplotlib.axes.Axes, optional
            Axes to draw in. Default: a new figure.
        spp : int
            Samples per pixel.
        camera, seed, progress
            As for `render`.

        Returns
        -------
        matplotlib.figure.Figure
            The figure, which a notebook shows.

        Raises
        ------
        NergError
            As for `render`.

        Examples
        --------
        >>> import nerg_mi as nerg
        >>> from importlib.resources import files
        >>> scene = nerg.Scene.load(files("nerg_mi.scenes.store") / "scene.xml", width=48, height=32)
        >>> len(scene.show(spp=1).axes)  # the picture, and the scale of the gaze
        2
        """
        import nerg_mi  # the functions above this module

        name = quantity or ("gaze" if self.has_gaze else COLOR)
        needed = [COLOR, *([] if name == COLOR else ["opacity", name])]
        pictures = nerg_mi.render(self, observer, needed, camera=camera, spp=spp, seed=seed, progress=progress)
        return pictures.plot(name, axes=axes)

    def _repr_html_(self) -> str:
        lines = [line.strip().partition(": ") for line in repr(self).splitlines()[1:]]
        return key_value_table((name, value) for name, _, value in lines)

    @property
    def integrator(self) -> Any:
        """The integrator ``nerg`` of the scene."""
        return self.mitsuba.integrator()

    @property
    def geometry(self) -> SceneGeometry:
        """The geometry that rays can hit: the field or volumes, and the shapes."""
        from nerg_mi.transport.geometry import SceneGeometry

        return SceneGeometry(self.integrator.medium, self.mitsuba)

    @property
    def observer_space(self) -> ObserverSpace:
        """What the scene's observers see: the geometry, the settings of their rays, and the frame of the gaze field."""
        gaze, settings = self.integrator.gaze, self.integrator.observer_settings
        return ObserverSpace(self.geometry, settings, Similarity() if gaze is None else gaze.to_world)

    @property
    def has_gaze(self) -> bool:
        """Whether the scene has a gaze field."""
        return self.integrator.gaze is not None

    @property
    def observer(self) -> Floats | None:
        """Position (3,) of the observer in scene units; None if the camera is the observer."""
        from nerg_mi.transport.observer import sensor_center

        sensor = self.integrator.observer
        return None if sensor is None else np.ravel(np.array(sensor_center(sensor), np.float32))

    def set_constant_weights(self, constant: bool = True) -> None:
        """Compile the weights of the trained fields into the kernels.

        This makes many images or rays of one scene faster, after some seconds of compilation. The results are
        identical. See "Weights as constants" on the page about performance.

        Parameters
        ----------
        constant : bool
            False reverts it.
        """
        from nerg_mi.fields.mlp import set_constant_weights

        from .bands import get_trained_fields

        for trained in get_trained_fields(self.integrator):
            set_constant_weights(trained, constant)

    def move_objects(
        self,
        objects: FilePath | ObjectPoses,
        time: float,
        *,
        person: str = "",
        align: FilePath | AnySimilarity | None = None,
    ) -> None:
        """Move shapes to where they were at a time, until the next call; those that were absent are shrunk to a point.

        A warning names objects whose pose is unknown. `save` writes the scene as it was before.

        Parameters
        ----------
        objects : ObjectPoses or path
            Poses of shapes (`nerg_mi.tracking.objects`).
        time : float
            Time in seconds on their clock.
        person : str
            The participant, if participants have poses of their own.
        align : path or similarity, optional
            Similarity from the frame of the poses to that of the scene. Default: the identity.

        Raises
        ------
        NergError
            No object is a shape of the scene, or a shape cannot be moved.
        """
        to_scene = Similarity() if align is None else open_similarity(align, "objects to scene")
        moment = Moment(ObjectPoses.open(objects), time, person, to_scene)
        self._mover = self._mover or ShapeMover(self.mitsuba)
        for name in self._mover.move(moment, time):
            WarningReporter().warn(f'the pose of the object "{sanitize(name, 40)}" is unknown then; it is left out')

    @property
    def default_quantities(self) -> tuple[str, ...]:
        """The quantities to compute if none are requested."""
        return (COLOR, "depth", "opacity", *(("gaze", "visibility") if self.has_gaze else ()))

    def resolve_sensor(self, camera: Camera | int | Sensor | None = None) -> Sensor:
        """Return a sensor for ``camera``.

        Parameters
        ----------
        camera : Camera, int or mi.Sensor, optional
            A `Camera`, the index of a sensor of the scene, or a Mitsuba sensor. Default: the first sensor of the scene.

        Returns
        -------
        mi.Sensor
            The sensor.

        Raises
        ------
        NergError
            The scene has no such sensor.
        """
        import mitsuba as mi

        if isinstance(camera, Camera):
            with translate_mitsuba_errors():
                return self._fit_clip_distances(mi.load_dict(camera.to_dict()), camera)
        if isinstance(camera, mi.Sensor):
            check_sensor(camera, "the to_world of the camera")
            return camera
        if not (camera is None or isinstance(camera, (int, np.integer))):
            raise NergError(f"a camera must be a Camera, an index or a Mitsuba sensor, got {type(camera).__name__}")
        sensors = self.mitsuba.sensors()
        if not 0 <= (number := camera or 0) < len(sensors):
            available = f"{len(sensors) or 'no'} sensor{'' if len(sensors) == 1 else 's'}"
            raise NergError(f"there is no camera {number}, the scene has {available}; pass camera=Camera(...)")
        return sensors[number]

    def _fit_clip_distances(self, sensor: Sensor, camera: Camera) -> Sensor:
        """Extend the clip distances of the ``sensor`` of ``camera`` to the extent of the scene."""
        import mitsuba as mi

        params: Any = mi.traverse(sensor)
        near, far = compute_clip_distances(self.geometry.extent(camera.origin))
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
        lines.append(f"  observer: {'the camera' if self.observer is None else _format_position(self.observer)}")
        for i, sensor in enumerate(self.mitsuba.sensors()):
            width, height = sensor.film().crop_size()
            lines.append(f"  camera {i}: {width} x {height} pixels")
        return "\n".join(["Scene", *lines])


AnyEnvironment: TypeAlias = Any
"""What observers see: a file, an `Environment`, a `Scene`, a radiance field, splats, a `DensityGrid`, a mesh or scene
of trimesh, a Mitsuba scene or shape, or a dict for ``mi.load_dict``."""


def make_scene(
    environment: AnyEnvironment = None,
    gaze: FilePath | TrainedField[GazeNetwork] | None = None,
    *,
    shapes: object = None,
    camera: Camera | Mapping[str, Any] | Sensor | None = None,
    observer: ArrayLike | None = None,
    to_world: ArrayLike | None = None,
    **settings: Unpack[IntegratorSettings],
) -> Scene:
    """Make a scene from an environment, a gaze field, or both, without writing XML.

    Parameters
    ----------
    environment : AnyEnvironment, optional
        What the observers see: a radiance field (`RadianceField`), Gaussian splats
        (`nerg_mi.fields.splats.Splats`) or a `DensityGrid`, in memory or as a file; a file of hit points (.vol) as
        written by `train_gaze` with ``environment="hits"``; or shapes as for ``shapes``. Hit points are grey, shaded by
        the orientation of their surfaces. Of a `Scene` of `make_scene`, or a dict of one, all is kept that no argument
        replaces: its gaze field, observer and cameras too. Of other scenes only shapes and lights are used.
    gaze : GazeField or path, optional
        The gaze field (`GazeField`), in memory or as a file.
    shapes : object, optional
        Further shapes: a mesh or scene of trimesh, a mesh file (.ply, .obj, .glb), a scene file, a dict for
        ``mi.load_dict``, a Mitsuba scene or shape, or several of these in a list or in a dict by name.
    camera : Camera, mapping or mi.Sensor, optional
        The camera.
    observer : array_like of shape (3,), optional
        Position of the observer in scene units. Default: the camera is the observer.
    to_world : array_like of shape (4, 4), optional
        Rotation, uniform scale and translation from the frame of both fields to the scene.
    **settings
        Parameters of the integrator ``nerg`` (`IntegratorSettings`), such as ``falloff=0.3``, ``visibility="map"`` or
        ``kde={"type": "gazekde", "filename": "day.npz"}``.

    Returns
    -------
    Scene
        The scene.

    Raises
    ------
    NergError
        An argument is invalid, or there is neither an environment nor a shape.

    Examples
    --------
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
    activate_mitsuba()
    if isinstance(settings.get("field"), (str, os.PathLike, TrainedField, Splats)):
        raise NergError('make_scene has no argument "field"; pass the field as the environment')
    check_settings(settings)
    integrator: dict[str, Any] = {"type": "nerg", **settings}
    transform = None if to_world is None else _as_transform(to_world)
    children: dict[str, Any] = {}
    environment = _unwrap_environment(environment)
    content, kind, path = find_content(environment), "", Path()
    if isinstance(environment, (str, os.PathLike)):
        path, kind = Path(environment), _find_kind(environment, "environment")
    if kind in ROLES:
        contained = "rays" if kind == "rays" else "a gaze field, which goes with gaze="
        raise NergError(f'"{environment}" contains {contained}; pass an environment')
    if isinstance(environment, TrainedField) and environment.kind == "gaze":
        raise NergError("the environment is a gaze field; pass it with gaze=")
    if content is not None:
        children = {k: v for k, v in content.items() if k != "type" and (camera is None or find_tag(v) != "sensor")}
        name = next(name for name, child in children.items() if find_tag(child) == "integrator")
        # The quantities of a scene without gaze are not those of one with gaze.
        left_out = ("type", "aovs") if gaze is not None else ("type",)
        integrator |= {k: v for k, v in children.pop(name).items() if k not in left_out} | settings
    elif kind == "hits":
        integrator = _make_hit_volumes(path, transform) | integrator
    elif isinstance(environment, GridVolume):
        integrator = _make_grid_volumes(environment, transform) | integrator
    elif isinstance(environment, DensityGrid):
        integrator = dict(environment.volumes(transform)) | integrator
    elif kind in ("field", "splats") or isinstance(environment, (TrainedField, Splats)):
        integrator["field"] = FieldVolume(environment, "field", transform)
    elif environment is not None:
        children = _take_shapes(environment, kind)
    if gaze is not None:
        if isinstance(gaze, (str, os.PathLike)):
            if (contained := _find_kind(gaze, "gaze")) != "gaze":
                raise NergError(f'gaze must be a gaze field, but "{gaze}" contains {contained}; pass another file')
        elif not isinstance(gaze, TrainedField) or gaze.kind != "gaze":
            raise NergError(f"gaze must be a gaze field, in memory or as a file, got {gaze!r}")
        integrator["gaze"] = FieldVolume(gaze, "gaze", transform)
    if observer is not None:
        position = as_points(observer, "the observer")
        if len(position) != 1:
            raise NergError("a scene has a single observer; pass several observers to render, observe or attention")
        integrator["observer"] = _make_observer_sensor(position[0])
    integrator.setdefault("aovs", ",".join(["depth", "opacity", *(["gaze", "visibility"] if gaze is not None else [])]))
    children |= to_scene_children(shapes, taken=children)
    if not children and integrator.keys().isdisjoint({"field", "density"}):
        raise NergError("the scene is empty; pass an environment or shapes to make_scene")
    if camera is not None:
        children["camera"] = camera.to_dict() if isinstance(camera, Camera) else camera
    scene = Scene._from_content({"type": "scene", "integrator": integrator, **children})
    if isinstance(camera, Camera):
        scene._fit_clip_distances(next(s for s in scene.mitsuba.sensors() if s.id() == "camera"), camera)
    return scene


def _make_observer_sensor(position: ArrayLike) -> dict:
    """Make the sensor of an observer at ``position`` (3,), of which only the position is used."""
    import mitsuba as mi

    to_world = mi.ScalarTransform4d().translate(np.asarray(position, np.float64).tolist())
    return {"type": "perspective", "to_world": to_world, "film": {"type": "hdrfilm", "width": 1, "height": 1}}


def make_aov_context(scene: Scene, quantities: Sequence[str]) -> Any:
    """Return the context that computes ``quantities`` of the scene.

    Its ``observer_aovs`` depend on the observer, its ``shared_aovs`` do not. Raises `NergError` for quantities that
    the scene cannot compute.
    """
    return scene.integrator.make_context([name for name in quantities if name != COLOR], COLOR in quantities)


def resolve_quantities(scene: Scene, names: object, allowed: tuple[str, ...] | None = None) -> tuple[str, ...]:
    """Return requested quantities without duplicates.

    Parameters
    ----------
    scene : Scene
        The scene.
    names : str, sequence of str or None
        Requested quantities; None selects the default.
    allowed : tuple of str, optional
        Allowed quantities. None: the integrator checks them later.

    Returns
    -------
    tuple of str
        The quantities.

    Raises
    ------
    NergError
        A name is not a string or not allowed.
    """
    if names is None:
        defaults = scene.default_quantities
        return tuple(name for name in defaults if allowed is None or name in allowed)
    requested = [names] if isinstance(names, str) else list(names) if isinstance(names, (list, tuple)) else None
    if not requested or not all(isinstance(name, str) for name in requested):
        raise NergError(f'quantities must be names such as "depth", got {names!r}')
    for name in requested:
        if allowed is not None and name not in allowed:
            raise NergError(f'the quantity "{name}" is not available here; available: {join_names(allowed)}')
    return tuple(dict.fromkeys(requested))


def find_content(environment: AnyEnvironment) -> dict[str, Any] | None:
    """The content of a scene with the integrator ``nerg`` that was made in Python; None for other environments."""
    if isinstance(environment, Scene):
        return environment._content
    is_scene = isinstance(environment, Mapping) and environment.get("type") == "scene"
    return dict(environment) if is_scene and has_nerg(environment) else None


def _unwrap_environment(environment: AnyEnvironment) -> AnyEnvironment:
    """Return the file or the object of an `Environment`, and others as they are. Raises `NergError` for one without
    surfaces."""
    import nerg_mi  # the class above this module

    if not isinstance(environment, nerg_mi.Environment):
        return environment
    if not environment.has_surfaces:
        raise NergError("the environment has no surfaces to show; leave it out, or pass another one")
    return environment.input


def _take_shapes(environment: AnyEnvironment, kind: str) -> dict[str, Any]:
    """The shapes and lights of an environment by name; ``kind`` is that of a file. Raises `NergError` for a loaded
    scene with a field."""
    import mitsuba as mi

    if kind == "scene":
        environment = load_scene(Path(environment))
    elif kind and kind != "mesh":
        import nerg_mi  # the class above this module

        environment = nerg_mi.Environment.open(environment).scene_geometry.scene
    elif isinstance(environment, Scene):
        environment = environment.mitsuba
    integrator: Any = environment.integrator() if isinstance(environment, mi.Scene) else None
    if is_nerg(integrator) and integrator.medium is not None:
        raise NergError(
            "the environment is a loaded scene, whose field cannot be shown in another scene; pass the file of the "
            "field, or show another gaze field in the scene with write_scene"
        )
    return to_scene_children(environment, "environment")


def _find_kind(value: str | os.PathLike, name: str) -> str:
    """Return what the file of an argument contains (`detect_kind`). Raises `NergError` if it does not exist."""
    if not os.path.exists(value):
        raise MissingFile(f'the file "{os.fspath(value)}" of "{name}" does not exist; correct the path')
    return detect_kind(Path(value))


def _make_hit_volumes(path: Path, to_world: Any) -> dict[str, Any]:
    """Make the density and the colour of a volume of hit points, as properties of the integrator."""
    density, lower, upper = read_hit_volume(path)
    world = {} if to_world is None else {"to_world": to_world}
    volume = {"type": "gridvolume", "filename": os.path.abspath(path), "use_grid_bbox": True, **world}
    return _make_grid_volumes(GridVolume(density, lower, upper), to_world) | {"density": volume}


def _make_grid_volumes(density: GridVolume, to_world: Any) -> dict[str, Any]:
    """As `_make_hit_volumes`, of a volume in memory."""
    color, upper = shade_hits(density.values, density.lower, density.upper)
    return {
        "density": GridVolume(density.values, density.lower, density.upper, to_world),
        "color": GridVolume(color, density.lower, upper, to_world),
        "background": {"type": "rgb", "value": NO_DATA_GREY},
    }


def _as_transform(matrix: ArrayLike) -> Any:
    import mitsuba as mi

    return mi.ScalarTransform4d(Similarity(to_numbers(getattr(matrix, "matrix", matrix), '"to_world"')).matrix)


def _format_position(position: Floats) -> str:
    return f"({', '.join(f'{x:.4g}' for x in position)})"
