"""Scenes and fields: opened, made of fields, meshes and observers, and what calls of workflows take of them."""

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
from nerg_mi.formats.fields import load_gaze as read_gaze
from nerg_mi.formats.fields import load_radiance, save_gaze, save_radiance
from nerg_mi.formats.meshes import read_mesh_file
from nerg_mi.formats.splats import choose_plugin
from nerg_mi.rays.rays import Rays
from nerg_mi.registration import get_plugin_class
from nerg_mi.rendering.bands import is_nerg
from nerg_mi.rendering.scene_writer import clip_distances
from nerg_mi.transport.geometry import check_shape

from .arrays import Camera, Floats, join_names, as_points

if TYPE_CHECKING:
    import mitsuba as mi
    from _typeshed import DataclassInstance

    from nerg_mi.transport.geometry import SceneGeometry


# ---- Shapes as a user has them (files, dicts, scenes, objects), as children of a Mitsuba scene ----


def load_mesh_child(path: str | os.PathLike[str]) -> Any:
    """The mesh file ``path`` as a child of a Mitsuba scene, in its colours or in grey, and seen from both sides: a
    dict, or a mesh of what Mitsuba does not show as it is. What of the file is not used goes to Mitsuba's log. Raises
    `NergError` for a file that is missing or damaged."""
    import mitsuba as mi

    from nerg_mi.surfaces.mesh import mitsuba_mesh

    mesh = read_mesh_file(path)
    log: Any = mi.Log  # of which the stubs know nothing
    for note in mesh.notes:
        log(mi.LogLevel.Warn, f"{path}: {note}")
    name, colors = ("face_color", mesh.face_colors) if mesh.colors is None else ("vertex_color", mesh.colors)
    tint = {} if colors is None else {"reflectance": {"type": "mesh_attribute", "name": name}}
    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", **tint}}
    if mesh.is_readable_by_mitsuba:
        return {"type": Path(path).suffix.lower()[1:], "filename": str(path), "bsdf": bsdf}
    shown = mitsuba_mesh(mesh.vertices, mesh.faces, Path(path).stem, bsdf)
    if colors is not None:
        shown.add_attribute(name, 3, colors.astype(np.float32).ravel())
    return shown


def to_scene_children(shapes: object, name: str = "shape") -> dict[str, Any]:
    """``shapes`` by their names, as a scene's dict takes them; the variant must be active.

    ``shapes``: a mesh file, a scene file, what `mi.load_dict` takes for a shape or a scene, a Mitsuba shape or scene,
    or several of these in a list or in a dict by name. ``name``: of those that bring none. Raises `NergError` for
    anything else.
    """
    import mitsuba as mi

    if shapes is None:
        return {}
    if isinstance(shapes, (str, os.PathLike)):
        if Path(shapes).suffix.lower() != ".xml":
            return {name: load_mesh_child(shapes)}
        from nerg_mi.rendering.scene import load_scene

        return _of_scene(load_scene(Path(shapes)), name)
    if isinstance(shapes, mi.Scene):
        return _of_scene(shapes, name)
    if isinstance(shapes, mi.Object):
        return {name: shapes}
    if isinstance(shapes, Mapping):
        if shapes.get("type") == "scene":
            with translate_mitsuba_errors():
                return _of_scene(mi.load_dict(dict(shapes), optimize=False), name)
        if "type" in shapes:
            return {name: dict(shapes)}
        named = [to_scene_children(child, str(key)) for key, child in shapes.items()]
    elif isinstance(shapes, (list, tuple)):
        named = [to_scene_children(child, f"{name}_{i}") for i, child in enumerate(shapes)]
    else:
        raise NergError(
            f"shapes are mesh or scene files, dicts for mi.load_dict or Mitsuba objects, got {type(shapes).__name__}"
        )
    return {key: child for children in named for key, child in children.items()}


def _of_scene(scene, name: str) -> dict[str, Any]:
    """Shapes of a scene, and those of its lights that are no shapes."""
    shapes = list(scene.shapes())
    found = {shape.id() or f"{name}_{i}": shape for i, shape in enumerate(shapes)}
    if len(found) < len(shapes):
        found = {f"{name}_{i}": shape for i, shape in enumerate(shapes)}
    lights = [light for light in scene.emitters() if not any(s.is_emitter() and s.emitter() is light for s in shapes)]
    return found | {f"{name}_light_{i}": light for i, light in enumerate(lights)}


# ---- The Mitsuba variant that the library works in: the one that is set, or the best where none is ----


def activate_mitsuba() -> ModuleType:
    """The module ``mitsuba`` with a variant that fields work in.

    A variant that is set stays set. Where none is, it is ``cuda_ad_rgb`` if that works here, and ``llvm_ad_rgb``
    otherwise, as for the command `nerg`. Raises `NergError` for a variant without kernels.
    """
    import mitsuba as mi

    variant = mi.variant()
    if variant is None:
        from nerg_mi.rendering.scene import activate_variant

        activate_variant()
    elif variant.startswith("scalar"):
        raise NergError(
            f'fields need a variant that compiles its kernels, and "{variant}" is active: '
            'call mi.set_variant("llvm_ad_rgb") (or "cuda_ad_rgb") first'
        )
    return mi


def get_array_module() -> ModuleType:
    """The Dr.Jit array types of the active variant (`nerg_mi.fields.mlp.namespace`)."""
    from nerg_mi.fields.mlp import namespace

    return namespace(activate_mitsuba().variant())


# ---- Fields and rays in memory: read from files, handed to scenes, and saved again ----


FilePath: TypeAlias = str | Path
Network = TypeVar("Network", RadianceField, AnyGazeField)


@dataclass(frozen=True, eq=False, repr=False)
class TrainedField(Generic[Network]):
    """A radiance field or a gaze field in memory.

    ``network``: the field itself (`nerg_mi.fields`), whose arrays belong to the variant that was active when it was
    made. ``provenance``: what it was trained on and with, as its file keeps it. ``name``: the file's, or what it is.
    ``path``: the checkpoint that holds it, None where there is none.
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
        """Lower and upper corner (2, 3) of where the field may hold density, in its own units."""
        return np.array([self.network.box.lower, self.network.box.upper], np.float64)

    @property
    def num_weights(self) -> int:
        """How many numbers were trained."""
        return sum(int(np.prod(value.shape)) for value in self.network.parameters().values())

    def save(self, path: FilePath, half: bool = False) -> Path:
        """Write a checkpoint (.safetensors), whole or not at all, and give its path; ``half``: weights in fp16.

        Raises `NergError` for weights that are not finite or exceed fp16, and for a file that cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() != ".safetensors":
            raise NergError(f'a field is saved as .safetensors, and "{path}" ends otherwise; choose another name')
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
    """Read a radiance field: density and colour of a place.

    ``path``: a checkpoint that ``nerg train radiance``, `train_radiance` or ``nerg import`` has written. Give what
    comes back to `make_scene`, look at ``.bounds``, write it again with ``.save(path)``. Raises `NergError` for a file
    that is missing, damaged, or holds something else.

    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> field = nerg.load_field(store / "store.safetensors")
    >>> field.bounds.tolist()
    [[-0.1, -0.1, -0.1], [8.1, 6.1, 3.1]]
    """
    network, metadata = load_radiance(_existing(path), get_array_module())
    return TrainedField(network, metadata.get("provenance", {}), Path(path).name, Path(path))


def load_gaze(path: FilePath) -> TrainedField[AnyGazeField]:
    """Read a gaze field, or an ensemble of them: how much surfaces attract an observer.

    ``path``: a checkpoint that ``nerg train gaze``, `train_gaze` or ``nerg import`` has written; the rest is as for
    `load_field`.

    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> gaze = nerg.load_gaze(store / "shoppers.safetensors")
    >>> gaze.kind
    'gaze'
    """
    network, metadata = read_gaze(_existing(path), get_array_module())
    return TrainedField(network, metadata.get("provenance", {}), Path(path).name, Path(path))


def load_rays(path: FilePath) -> Rays:
    """Read rays of attention: who looked from where to where, and when.

    ``path``: a file (.npz or .parquet) that ``nerg rays import``, `import_rays` or the method ``save`` of rays has
    written; or a dataset (.rays), of at most 50 million rays. Right-handed, z up, metres and seconds (`Rays`). Raises
    `NergError` for a file that is missing or damaged.

    >>> import nerg_mi as nerg
    >>> rays = nerg.Rays(t=[0, 0.1], person=[0, 0], persons=("Ada",), origin=[[1, 1, 1.6]] * 2,
    ...                  direction=[[1, 0, 0], [0, 1, 0]], confidence=[1, 1])
    >>> rays.save(folder / "rays.npz")
    >>> len(nerg.load_rays(folder / "rays.npz"))
    2
    """
    from nerg_mi.rays.dataset import load_rays as load

    return load(_existing(path))


def _existing(path: FilePath) -> Path:
    try:
        return Path(path)
    except TypeError as error:
        raise NergError(f"a file is named by a string or a path, got {type(path).__name__}") from error


# ---- What a call of the library is given, looked at before any work: names of options first, then files ----


Options = TypeVar("Options", bound="DataclassInstance")

_WRITTEN = {"pictures", "json_file", "store"}
"""Options that name a file or a folder which is written."""


def build_options(kind: type[Options], job: str, given: Options | None, changes: dict[str, Any]) -> Options:
    """An object of the dataclass ``kind``: ``given`` (or the defaults) with ``changes``, for the variant in use. Files
    may be named by strings.

    Raises `NergError` for an option that the ``job`` has not, naming those that it has, and for a file that is missing
    or is none.
    """
    types = {f.name: str(f.type) for f in fields(kind)}
    if "mode" in changes:
        raise NergError(f"{job} works in the variant that is set; call mi.set_variant({changes['mode']!r}) before it")
    check_names(job, changes, [name for name in types if name != "mode"])
    if "mode" in types:
        changes = {**changes, "mode": activate_mitsuba().variant()}
    options = replace(kind() if given is None else given, **changes)
    files = {k: getattr(options, k) for k, of in types.items() if "Path" in of}
    return replace(
        options, **{k: Path(v) if k in _WRITTEN else resolve_file(v, k) for k, v in files.items() if v is not None}
    )


def check_names(function: str, names: Iterable[str], allowed: Collection[str], noun: str = "option") -> None:
    """Raise `NergError` for a name ``given`` that is none of those ``known``."""
    for name in names:
        if name not in allowed:
            near = difflib.get_close_matches(name, allowed, n=1)
            meant = f'did you mean "{near[0]}"?' if near else f"it has {join_names(list(allowed))}"
            raise NergError(f'{function} has no {noun} "{name}"; {meant}')


def resolve_file(value: object, name: str) -> Path:
    """The file or folder that the argument ``name`` is: a string, a path, or a field or scene that has a file.

    Raises `NergError` for one that is missing, and for anything else.
    """
    path = getattr(value, "path", None) or value
    if not isinstance(path, (str, os.PathLike)):
        remedy = "save it, and give the file" if hasattr(value, "save") else "give its name"
        raise NergError(f'"{name}" is a file, named by a string or a path, got {type(value).__name__}; {remedy}')
    if not os.path.exists(path):
        raise MissingFile(f'there is no file "{os.fspath(path)}", which "{name}" names; correct its name')
    return Path(path)


def resolve_rays(value: object) -> Rays | Path:
    """Rays in memory as they are, or their file. Raises `NergError` for anything else."""
    if isinstance(value, Rays):
        return value
    if not isinstance(value, (str, os.PathLike)):
        raise NergError(
            f"rays are what load_rays and import_rays give, or a file of theirs, got {type(value).__name__}; "
            "import_rays makes rays of a table (.csv, .parquet)"
        )
    return resolve_file(value, "rays")


@contextmanager
def resolve_checkpoint(value: object, name: str) -> Iterator[Path]:
    """The checkpoint of a field that is the argument ``name``: its file, or one that is written for the block."""
    if isinstance(value, TrainedField) and value.path is None:
        with TemporaryDirectory() as folder:
            yield value.save(Path(folder) / f"{value.kind}.safetensors")
        return
    yield resolve_file(value, name)


# ---- Scenes: a place, whose gaze it is, and from where it is seen ----


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

        activate_mitsuba()
        # Merged meshes lose their names.
        scene = cls(load_scene(Path(path), {key: str(value) for key, value in values.items()}, merge=False))
        scene.path = None if values else Path(path)
        return scene

    @classmethod
    def coerce(cls, given: Scene | FilePath | mi.Scene) -> Scene:
        """A scene as a call is given it: one of these, a file of one, or Mitsuba's. Raises `NergError` for anything
        else."""
        if isinstance(given, Scene):
            return given
        if isinstance(given, (str, os.PathLike)):
            return cls.load(given)
        import mitsuba as mi

        activate_mitsuba()
        if isinstance(given, mi.Scene):
            return cls(given)
        raise NergError(f"a scene is what make_scene and Scene.load give, or a scene file, got {type(given).__name__}")

    @property
    def integrator(self) -> Any:
        """The scene's integrator."""
        return self.mitsuba.integrator()

    @property
    def geometry(self) -> SceneGeometry:
        """What rays of this scene meet: its field or volumes, and its shapes."""
        from nerg_mi.transport.geometry import SceneGeometry

        return SceneGeometry(self.integrator.medium, self.mitsuba)

    @property
    def has_gaze(self) -> bool:
        """Whether there is a gaze field."""
        return self.integrator.gaze is not None

    @property
    def observer(self) -> Floats | None:
        """Position (3,) of the scene's own observer; None where the camera is the observer."""
        from nerg_mi.transport.observer import sensor_center

        sensor = self.integrator.observer
        return None if sensor is None else np.ravel(np.array(sensor_center(sensor), np.float32))

    def set_constant_weights(self, constant: bool = True) -> None:
        """Write the weights of its trained fields into the kernels, for many pictures or rays of one scene: the same
        results to the bit in less time, after some seconds of compilation (the page on performance, "Weights as
        constants"). ``constant`` false takes it back."""
        from nerg_mi.fields.mlp import set_constant_weights
        from nerg_mi.rendering.bands import get_trained_fields

        for trained in get_trained_fields(self.integrator):
            set_constant_weights(trained, constant)

    @property
    def default_quantities(self) -> tuple[str, ...]:
        """What is computed when nothing is asked for by name."""
        return (COLOR, "depth", "opacity", *(("gaze", "visibility") if self.has_gaze else ()))

    def resolve_sensor(self, camera: Camera | int | mi.Sensor | None = None) -> mi.Sensor:
        """The sensor that ``camera`` names: a `Camera`, one of the scene's own by its number, or a Mitsuba sensor;
        without any the scene's first. Raises `NergError` where there is none."""
        import mitsuba as mi

        if isinstance(camera, Camera):
            with translate_mitsuba_errors():
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
        near, far = clip_distances(self.geometry.extent(camera.origin))
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

    activate_mitsuba()
    # Objects may be nested by any name.
    check_names("make_scene", (k for k, v in settings.items() if isinstance(v, _PLAIN)), _parameters(), "setting")
    integrator: dict[str, Any] = {"type": "nerg", **settings}
    where = None if to_world is None else _transform(to_world)
    if field is not None:
        integrator["field"] = _volume(field, "field", where)
    if gaze is not None:
        integrator["gaze"] = _volume(gaze, "gaze", where)
    if observer is not None:
        position = as_points(observer, "the observer")
        if len(position) != 1:
            raise NergError("a scene has one observer; give render, observe or attention the others")
        integrator["observer"] = _observer_sensor(position[0])
    integrator.setdefault("aovs", ",".join(["depth", "opacity", *(["gaze", "visibility"] if gaze is not None else [])]))
    children = to_scene_children(shapes)
    if not children and integrator.keys().isdisjoint({"field", "density"}):
        raise NergError("there is nothing to see in this scene; give make_scene a field or shapes")
    if camera is not None:
        children["camera"] = camera.to_dict() if isinstance(camera, Camera) else camera
    with translate_mitsuba_errors():
        # Merged meshes lose their names.
        scene = Scene(mi.load_dict({"type": "scene", "integrator": integrator, **children}, optimize=False))
    if isinstance(camera, Camera):
        scene._fitted(next(s for s in scene.mitsuba.sensors() if s.id() == "camera"), camera)
    return scene


_PLAIN = (str, bool, int, float, np.number)


def _parameters() -> list[str]:
    """The parameters of the integrator ``nerg``, which its manual lists."""
    manual = sys.modules[get_plugin_class("nerg").__module__].__doc__ or ""
    rows = re.findall(r"^ \* - ([a-z_]+(?:, [a-z_]+)*)$", manual, re.MULTILINE)
    return [name for row in rows for name in row.split(", ")]


def _observer_sensor(position: ArrayLike) -> dict:
    """An observer at ``position`` (3,) as the integrator takes it: a sensor of which only the centre counts."""
    import mitsuba as mi

    place = mi.ScalarTransform4d().translate(np.asarray(position, np.float64).tolist())
    return {"type": "perspective", "to_world": place, "film": {"type": "hdrfilm", "width": 1, "height": 1}}


def make_aov_context(scene: Scene, quantities: Sequence[str]) -> Any:
    """What ``quantities`` of the scene are computed with; the ``own`` depend on the observer, the ``shared`` do not.

    Raises `NergError` for those that it cannot compute.
    """
    return scene.integrator.make_context([name for name in quantities if name != COLOR], COLOR in quantities)


def resolve_quantities(scene: Scene, names: object, allowed: tuple[str, ...] | None = None) -> tuple[str, ...]:
    """The quantities ``names`` (a name, several, or None for the scene's own choice), each once.

    ``known``: those that may be asked for; None leaves it to the integrator to say. Raises `NergError`.
    """
    if names is None:
        chosen = scene.default_quantities
        return tuple(name for name in chosen if allowed is None or name in allowed)
    given = [names] if isinstance(names, str) else list(names) if isinstance(names, (list, tuple)) else None
    if not given or not all(isinstance(name, str) for name in given):
        raise NergError(f'quantities are names such as "depth", got {names!r}')
    for name in given:
        if allowed is not None and name not in allowed:
            raise NergError(f'there is no quantity "{name}" here; there are {join_names(allowed)}')
    return tuple(dict.fromkeys(given))


def _volume(given: object, role: str, to_world: Any) -> Any:
    """The volume of a field, which is a file or in memory, for the integrator's property ``role``."""
    plugin = {"field": "splats" if isinstance(given, Splats) else "nerf", "gaze": "gazefield"}[role]
    if isinstance(given, (str, os.PathLike)):
        given = resolve_file(given, role)
        plugin = choose_plugin(given) if role == "field" else plugin
        where = {} if to_world is None else {"to_world": to_world}
        return {"type": plugin, "filename": os.path.abspath(given), **where}
    volume = get_plugin_class(plugin)
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
