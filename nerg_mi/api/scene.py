"""Scenes and fields: loading and construction, and the conversion of arguments of API functions."""

from __future__ import annotations

import difflib
import os
import re
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nerg_mi.errors import MissingFile, NergError, translate_mitsuba_errors
from nerg_mi.fields.gaze_base import AnyGazeField
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.fields.splats import Splats
from nerg_mi.formats.fields import load_radiance, save_gaze, save_radiance
from nerg_mi.formats.meshes import read_mesh_file
from nerg_mi.formats.splats import choose_plugin
from nerg_mi.rays.rays import Rays
from nerg_mi.registration import get_plugin_class
from nerg_mi.rendering.bands import is_nerg
from nerg_mi.rendering.scene_writer import compute_clip_distances
from nerg_mi.transport.geometry import check_shape
from nerg_mi.workflows.old_names import current_keywords

from .arrays import Camera, Floats, as_points, join_names

if TYPE_CHECKING:
    import mitsuba as mi
    from _typeshed import DataclassInstance

    from nerg_mi.transport.geometry import SceneGeometry


# ---- Shapes (files, dicts, scenes, objects) as children of a Mitsuba scene ----


def load_mesh_child(path: str | os.PathLike[str]) -> Any:
    """Load a mesh file as a two-sided child of a Mitsuba scene, with its colours or in grey.

    Unused parts of the file are reported in Mitsuba's log.

    Parameters
    ----------
    path : path-like
        Mesh file.

    Returns
    -------
    dict or mi.Mesh
        A dict for ``mi.load_dict``; a mesh if Mitsuba cannot read the file as it is.

    Raises
    ------
    NergError
        The file does not exist or is damaged.
    """
    import mitsuba as mi

    from nerg_mi.surfaces.mesh import mitsuba_mesh

    mesh = read_mesh_file(path)
    log: Any = mi.Log  # missing in the stubs
    for note in mesh.notes:
        log(mi.LogLevel.Warn, f"{path}: {note}")
    name, colors = ("face_color", mesh.face_colors) if mesh.colors is None else ("vertex_color", mesh.colors)
    color_texture = {} if colors is None else {"reflectance": {"type": "mesh_attribute", "name": name}}
    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", **color_texture}}
    if mesh.is_readable_by_mitsuba:
        return {"type": Path(path).suffix.lower()[1:], "filename": str(path), "bsdf": bsdf}
    shape = mitsuba_mesh(mesh.vertices, mesh.faces, Path(path).stem, bsdf)
    if colors is not None:
        shape.add_attribute(name, 3, colors.astype(np.float32).ravel())
    return shape


def to_scene_children(shapes: object, name: str = "shape") -> dict[str, Any]:
    """Convert shapes to children of a Mitsuba scene dict; the variant must be active.

    Parameters
    ----------
    shapes : object
        A mesh file, a scene file, a dict for ``mi.load_dict``, a Mitsuba shape or scene, or several of these in a list
        or in a dict by name.
    name : str
        Name of shapes that have none.

    Returns
    -------
    dict of str to object
        The children by name.

    Raises
    ------
    NergError
        ``shapes`` is something else.
    """
    import mitsuba as mi

    if shapes is None:
        return {}
    if isinstance(shapes, (str, os.PathLike)):
        if Path(shapes).suffix.lower() != ".xml":
            return {name: load_mesh_child(shapes)}
        from nerg_mi.rendering.scene import load_scene

        return _list_scene_children(load_scene(Path(shapes)), name)
    if isinstance(shapes, mi.Scene):
        return _list_scene_children(shapes, name)
    if isinstance(shapes, mi.Object):
        return {name: shapes}
    if isinstance(shapes, Mapping):
        if shapes.get("type") == "scene":
            with translate_mitsuba_errors():
                return _list_scene_children(mi.load_dict(dict(shapes), optimize=False), name)
        if "type" in shapes:
            return {name: dict(shapes)}
        named = [to_scene_children(child, str(key)) for key, child in shapes.items()]
    elif isinstance(shapes, (list, tuple)):
        named = [to_scene_children(child, f"{name}_{i}") for i, child in enumerate(shapes)]
    else:
        raise NergError(
            "shapes must be mesh files, scene files, dicts for mi.load_dict or Mitsuba objects, "
            f"got {type(shapes).__name__}"
        )
    return {key: child for children in named for key, child in children.items()}


def _list_scene_children(scene, name: str) -> dict[str, Any]:
    """Return the shapes of a scene by name, and its emitters that are not shapes."""
    shapes = list(scene.shapes())
    named = {shape.id() or f"{name}_{i}": shape for i, shape in enumerate(shapes)}
    if len(named) < len(shapes):
        named = {f"{name}_{i}": shape for i, shape in enumerate(shapes)}
    lights = [light for light in scene.emitters() if not any(s.is_emitter() and s.emitter() is light for s in shapes)]
    return named | {f"{name}_light_{i}": light for i, light in enumerate(lights)}


# ---- The active Mitsuba variant ----


def activate_mitsuba() -> ModuleType:
    """Import Mitsuba with a variant active.

    An active variant is kept. Otherwise ``cuda_ad_rgb`` is activated if it works, and ``llvm_ad_rgb`` if not, as in the
    command `nerg`.

    Returns
    -------
    module
        ``mitsuba``.

    Raises
    ------
    NergError
        A scalar variant is active.
    """
    import mitsuba as mi

    variant = mi.variant()
    if variant is None:
        from nerg_mi.rendering.scene import activate_variant

        activate_variant()
    elif variant.startswith("scalar"):
        raise NergError(
            f'fields do not support scalar variants such as "{variant}"; '
            'call mi.set_variant("llvm_ad_rgb") or mi.set_variant("cuda_ad_rgb") first'
        )
    return mi


def get_array_module() -> ModuleType:
    """Return the Dr.Jit array types of the active variant (`nerg_mi.fields.mlp.namespace`)."""
    from nerg_mi.fields.mlp import namespace

    return namespace(activate_mitsuba().variant())


# ---- Fields and gaze samples in memory ----


FilePath: TypeAlias = str | Path
Network = TypeVar("Network", RadianceField, AnyGazeField)


@dataclass(frozen=True, eq=False, repr=False)
class TrainedField(Generic[Network]):
    """A radiance field or a gaze field in memory.

    Attributes
    ----------
    network : RadianceField or gaze field
        The field (`nerg_mi.fields`). Its arrays belong to the variant that was active when it was created.
    provenance : mapping
        Training data, options and scores, as stored in the file.
    name : str
        Name of the file.
    path : Path or None
        The checkpoint; None if the field is not saved.
    """

    network: Network
    provenance: Mapping[str, Any] = field(default_factory=dict)
    name: str = "in memory"
    path: Path | None = None

    @property
    def kind(self) -> str:
        """``radiance`` or ``gaze``."""
        return "radiance" if isinstance(self.network, RadianceField) else "gaze"

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lower and upper corner (2, 3) of the bounding box of the field, in its own units."""
        return np.array([self.network.box.lower, self.network.box.upper], np.float64)

    @property
    def num_weights(self) -> int:
        """Number of trained weights."""
        parameters = self.network.parameters()
        return sum(int(np.prod(value.shape)) for name, value in parameters.items() if not name.startswith("voxels."))

    def save(self, path: FilePath, half: bool = False) -> Path:
        """Write a checkpoint (.safetensors) atomically.

        Parameters
        ----------
        path : path
            File to write.
        half : bool
            Whether to store the weights as fp16 instead of fp32.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        NergError
            The weights are not finite or exceed fp16, or the file cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() != ".safetensors":
            raise NergError(f'fields are saved as .safetensors; change the file name extension of "{path}"')
        if isinstance(self.network, RadianceField):
            save_radiance(self.network, path, dict(self.provenance), half)
        else:
            save_gaze(self.network, path, dict(self.provenance), half)
        return path

    def __repr__(self) -> str:
        lower, upper = (", ".join(f"{x:.3g}" for x in corner) for corner in self.bounds)
        members = 1 if isinstance(self.network, RadianceField) else len(self.network.members)
        what = f"{self.kind} field" if members == 1 else f"ensemble of {members} gaze fields"
        return f"<{what} {self.name}: {self.num_weights:,} weights, box ({lower}) to ({upper})>"


def load_field(path: FilePath) -> TrainedField[RadianceField]:
    """Load a radiance field: density and colour of an environment.

    Parameters
    ----------
    path : path
        A checkpoint written by ``nerg train radiance``, `train_radiance` or ``nerg import``.

    Returns
    -------
    TrainedField
        The field, for `make_scene`.

    Raises
    ------
    NergError
        The file does not exist, is damaged, or contains something else.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> field = nerg.load_field(store / "store.safetensors")
    >>> field.bounds.tolist()
    [[-0.1, -0.1, -0.1], [8.1, 6.1, 3.1]]
    """
    network, metadata = load_radiance(as_path(path), get_array_module())
    return TrainedField(network, metadata.get("provenance", {}), Path(path).name, Path(path))


def load_rays(path: FilePath) -> Rays:
    """Load recorded gaze samples.

    Parameters
    ----------
    path : path
        A file (.npz or .parquet) written by ``nerg rays import``, `import_rays` or `Rays.save`, or a dataset (.rays) of
        at most 50 million samples.

    Returns
    -------
    Rays
        The samples, right-handed with z up, in metres and seconds.

    Raises
    ------
    NergError
        The file does not exist or is damaged.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> rays = nerg.Rays(t=[0, 0.1], person=[0, 0], persons=("Ada",), origin=[[1, 1, 1.6]] * 2,
    ...                  direction=[[1, 0, 0], [0, 1, 0]], confidence=[1, 1])
    >>> rays.save(folder / "rays.npz")
    >>> len(nerg.load_rays(folder / "rays.npz"))
    2
    """
    from nerg_mi.rays.dataset import load_rays as load

    return load(as_path(path))


def as_path(path: FilePath) -> Path:
    """Return ``path`` as a `Path`. Raises `NergError` for anything but a string or a path."""
    try:
        return Path(path)
    except TypeError as error:
        raise NergError(f"a file must be given as a string or a path, got {type(path).__name__}") from error


# ---- Checks of options and files, before any computation ----


Options = TypeVar("Options", bound="DataclassInstance")

_OUTPUT_OPTIONS = {"pictures", "json_file", "store"}
"""Options that name a file or folder to write."""


def build_options(kind: type[Options], function: str, options: Options | None, overrides: dict[str, Any]) -> Options:
    """Build the options of a workflow for the active variant.

    Parameters
    ----------
    kind : type
        Dataclass of the options.
    function : str
        Name of the API function, for messages.
    options : dataclass instance or None
        Base options; None uses the defaults.
    overrides : dict
        Values by option name. Files can be given as strings.

    Returns
    -------
    dataclass instance
        The options.

    Raises
    ------
    NergError
        An option or a file does not exist.
    """
    types, overrides = {f.name: str(f.type) for f in fields(kind)}, current_keywords(kind, overrides)
    if "mode" in overrides:
        raise NergError(f"{function} uses the active variant; call mi.set_variant({overrides['mode']!r}) before it")
    check_names(function, overrides, [name for name in types if name != "mode"])
    if "mode" in types:
        overrides = {**overrides, "mode": activate_mitsuba().variant()}
    updated = replace(kind() if options is None else options, **overrides)
    files = {k: getattr(updated, k) for k, type_name in types.items() if "Path" in type_name}
    return replace(
        updated,
        **{k: Path(v) if k in _OUTPUT_OPTIONS else resolve_file(v, k) for k, v in files.items() if v is not None},
    )


def check_names(function: str, names: Iterable[str], allowed: Collection[str], noun: str = "option") -> None:
    """Check names of options.

    Parameters
    ----------
    function : str
        Name of the API function, for messages.
    names : iterable of str
        Names to check.
    allowed : collection of str
        Allowed names.
    noun : str
        What the names stand for, for messages.

    Raises
    ------
    NergError
        A name is not allowed; the message suggests a similar one.
    """
    for name in names:
        if name not in allowed:
            near = difflib.get_close_matches(name, allowed, n=1)
            meant = f'did you mean "{near[0]}"?' if near else f"available: {join_names(list(allowed))}"
            raise NergError(f'{function} has no {noun} "{name}"; {meant}')


def resolve_file(value: object, name: str) -> Path:
    """Return the file that an argument names.

    Parameters
    ----------
    value : object
        A string, a path, or a field or scene that has a file.
    name : str
        Name of the argument, for messages.

    Returns
    -------
    Path
        The existing file.

    Raises
    ------
    NergError
        The file does not exist, or ``value`` is something else.
    """
    path = getattr(value, "path", None) or value
    if not isinstance(path, (str, os.PathLike)):
        remedy = "; save it and pass the file" if hasattr(value, "save") else ""
        raise NergError(f'"{name}" must be a file, given as a string or a path, got {type(value).__name__}{remedy}')
    if not os.path.exists(path):
        raise MissingFile(f'the file "{os.fspath(path)}" of "{name}" does not exist; correct the path')
    return Path(path)


def resolve_rays(value: object) -> Rays | Path:
    """Return `Rays` unchanged, or the path of their file. Raises `NergError` for anything else."""
    if isinstance(value, Rays):
        return value
    if not isinstance(value, (str, os.PathLike)):
        raise NergError(
            f"rays must be a Rays object or a file of one, got {type(value).__name__}; "
            "use import_rays to read a table (.csv, .parquet)"
        )
    return resolve_file(value, "rays")


@contextmanager
def resolve_checkpoint(value: object, name: str) -> Iterator[Path]:
    """Yield the checkpoint of a field: its file, or a temporary one for the duration of the block."""
    if isinstance(value, TrainedField) and value.path is None:
        with TemporaryDirectory() as folder:
            yield value.save(Path(folder) / f"{value.kind}.safetensors")
        return
    yield resolve_file(value, name)


# ---- Scenes ----


COLOR = "color"
"""Name of the linear colour, the only quantity that is not an AOV."""


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

    def __init__(self, mitsuba: mi.Scene):
        integrator = mitsuba.integrator()
        if not is_nerg(integrator):
            have = "none" if integrator is None else f'"{integrator.class_name()}"'
            raise NergError(
                f'a scene needs the integrator "nerg", but this one has {have}; '
                "use make_scene(shapes=scene) to make a scene with its shapes"
            )
        for shape in mitsuba.shapes():
            check_shape(shape)
        self.mitsuba = mitsuba
        self.path: Path | None = None

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
        from nerg_mi.rendering.scene import load_scene

        activate_mitsuba()
        # Merged meshes would lose their names.
        scene = cls(load_scene(Path(path), {key: str(value) for key, value in values.items()}, merge=False))
        scene.path = None if values else Path(path)
        return scene

    @classmethod
    def coerce(cls, scene: Scene | FilePath | mi.Scene) -> Scene:
        """Return ``scene`` as a `Scene`; a scene file is loaded, and a Mitsuba scene is wrapped. Raises `NergError`."""
        if isinstance(scene, Scene):
            return scene
        if isinstance(scene, (str, os.PathLike)):
            return cls.load(scene)
        import mitsuba as mi

        activate_mitsuba()
        if isinstance(scene, mi.Scene):
            return cls(scene)
        raise NergError(f"a scene must be a Scene, a Mitsuba scene or a scene file, got {type(scene).__name__}")

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
        from nerg_mi.rendering.bands import get_trained_fields

        for trained in get_trained_fields(self.integrator):
            set_constant_weights(trained, constant)

    @property
    def default_quantities(self) -> tuple[str, ...]:
        """The quantities to compute if none are requested."""
        return (COLOR, "depth", "opacity", *(("gaze", "visibility") if self.has_gaze else ()))

    def resolve_sensor(self, camera: Camera | int | mi.Sensor | None = None) -> mi.Sensor:
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
            return camera
        if not (camera is None or isinstance(camera, (int, np.integer))):
            raise NergError(f"a camera must be a Camera, an index or a Mitsuba sensor, got {type(camera).__name__}")
        sensors = self.mitsuba.sensors()
        if not 0 <= (number := camera or 0) < len(sensors):
            available = f"{len(sensors) or 'no'} sensor{'' if len(sensors) == 1 else 's'}"
            raise NergError(f"there is no camera {number}, the scene has {available}; pass camera=Camera(...)")
        return sensors[number]

    def _fit_clip_distances(self, sensor: mi.Sensor, camera: Camera) -> mi.Sensor:
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
    """Make a scene from fields, shapes or both, without writing XML.

    Parameters
    ----------
    field : TrainedField, RadianceField, Splats or path, optional
        The environment: a radiance field (`load_field`, `train_radiance`) or Gaussian splats
        (`nerg_mi.formats.splats.read_splats`), in memory or as a file, or a file of hit points (.vol) as written by
        `train_gaze` with ``geometry="hits"``. Hit points are grey, shaded by the orientation of their surfaces.
    gaze : TrainedField, gaze field or path, optional
        The gaze field (`load_gaze`, `train_gaze`), in memory or as a file.
    shapes : object, optional
        Shapes in the environment, or all of it: a mesh file (.ply, .obj, .glb), a scene file, a dict for
        ``mi.load_dict``, a Mitsuba scene or shape, or several of these in a list or in a dict by name.
    camera : Camera, mapping or mi.Sensor, optional
        The camera.
    observer : array_like of shape (3,), optional
        Position of the observer in scene units. Default: the camera is the observer.
    to_world : array_like of shape (4, 4), optional
        Rotation, uniform scale and translation from the frame of both fields to the scene.
    **settings
        Parameters of the integrator ``nerg``, such as ``falloff=0.3``, ``visibility="map"``, ``density={"type": ...}``
        or ``kde={"type": "gazekde", "filename": "day.npz"}``. They are documented in its docstring.

    Returns
    -------
    Scene
        The scene.

    Raises
    ------
    NergError
        An argument is invalid, or there is neither a field nor a shape.

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
    import mitsuba as mi

    activate_mitsuba()
    # Children of the integrator can have any name.
    check_names(
        "make_scene",
        (k for k, v in settings.items() if isinstance(v, _SCALAR_TYPES)),
        _integrator_parameters(),
        "setting",
    )
    integrator: dict[str, Any] = {"type": "nerg", **settings}
    transform = None if to_world is None else _as_transform(to_world)
    if isinstance(field, (str, os.PathLike)) and Path(field).suffix.lower() == ".vol":
        integrator = _make_hit_volumes(resolve_file(field, "field"), transform) | integrator
    elif field is not None:
        integrator["field"] = _make_volume(field, "field", transform)
    if gaze is not None:
        integrator["gaze"] = _make_volume(gaze, "gaze", transform)
    if observer is not None:
        position = as_points(observer, "the observer")
        if len(position) != 1:
            raise NergError("a scene has a single observer; pass several observers to render, observe or attention")
        integrator["observer"] = _make_observer_sensor(position[0])
    integrator.setdefault("aovs", ",".join(["depth", "opacity", *(["gaze", "visibility"] if gaze is not None else [])]))
    children = to_scene_children(shapes)
    if not children and integrator.keys().isdisjoint({"field", "density"}):
        raise NergError("the scene is empty; pass a field or shapes to make_scene")
    if camera is not None:
        children["camera"] = camera.to_dict() if isinstance(camera, Camera) else camera
    with translate_mitsuba_errors():
        # Merged meshes would lose their names.
        scene = Scene(mi.load_dict({"type": "scene", "integrator": integrator, **children}, optimize=False))
    if isinstance(camera, Camera):
        scene._fit_clip_distances(next(s for s in scene.mitsuba.sensors() if s.id() == "camera"), camera)
    return scene


_SCALAR_TYPES = (str, bool, int, float, np.number)


def _integrator_parameters() -> list[str]:
    """Return the parameters of the integrator ``nerg``, as listed in its manual."""
    manual = sys.modules[get_plugin_class("nerg").__module__].__doc__ or ""
    rows = re.findall(r"^ \* - ([a-z_]+(?:, [a-z_]+)*)$", manual, re.MULTILINE)
    return [name for row in rows for name in row.split(", ")]


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


def _make_volume(field: object, role: str, to_world: Any) -> Any:
    """Make the volume of a field, a file or an object, for the integrator's property ``role``."""
    plugin = {"field": "splats" if isinstance(field, Splats) else "nerf", "gaze": "gazefield"}[role]
    if isinstance(field, (str, os.PathLike)):
        field = resolve_file(field, role)
        plugin = choose_plugin(field) if role == "field" else plugin
        transform = {} if to_world is None else {"to_world": to_world}
        return {"type": plugin, "filename": os.path.abspath(field), **transform}
    volume = get_plugin_class(plugin)
    if isinstance(field, TrainedField):
        return volume.from_network(field.network, to_world, field.name)
    return volume.from_network(field, to_world)


def _make_hit_volumes(path: Path, to_world: Any) -> dict[str, Any]:
    """Make the density and the colour of a volume of hit points, as properties of the integrator."""
    import mitsuba as mi

    from nerg_mi.train.geometry import make_volume_dict
    from nerg_mi.workflows.scene_places import shade_hit_volume

    color, lower, upper = shade_hit_volume(path)
    world: Any = mi.ScalarTransform4d() if to_world is None else to_world
    in_box = world @ mi.ScalarTransform4d().translate(lower.tolist()).scale((upper - lower).tolist())
    density = make_volume_dict(os.path.abspath(path))
    if to_world is not None:
        density["to_world"] = to_world
    return {
        "density": density,
        "color": {"type": "gridvolume", "grid": mi.VolumeGrid(color), "raw": True, "to_world": in_box},
    }


def _as_transform(matrix: ArrayLike) -> Any:
    import mitsuba as mi

    from nerg_mi.maths.geometry import Similarity

    matrix = np.array(getattr(matrix, "matrix", matrix), np.float64)
    if matrix.shape != (4, 4):
        raise NergError(f'"to_world" must have the shape (4, 4), got {matrix.shape}')
    return mi.ScalarTransform4d(Similarity(matrix).matrix)


def _format_position(position: Floats) -> str:
    return f"({', '.join(f'{x:.4g}' for x in position)})"
