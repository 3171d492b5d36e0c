"""Subjects of a study: scenes that are rendered at many settings and compared with true values."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.environment.bands import is_nerg
from nerg_mi.environment.scene_loading import load_scene
from nerg_mi.errors import NergError, parameter
from nerg_mi.fields.compilation import attach_voxels, bound_voxel_bytes, compile_density
from nerg_mi.files.safe_read import resolve_path
from nerg_mi.transport.depth import DEPTHS
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.observer import sensor_center
from nerg_mi.transport.occlusion import RELATIVE_TOLERANCE

from .study_scenes import SCENES, AnalyticScene, make_sensor, make_volumes
from .study_truth import (
    COLOR_SPP,
    REFERENCE_EXTENTS,
    SPLAT_SOURCE,
    StudyTruth,
    apply_splat_extent,
    compute_errors,
    compute_truth,
    compute_truth_of_shapes,
    distance_and_direction,
    extract_triangles,
    find_first_hit,
    find_first_solid,
)

# ---- Reading the settings of an integrator, to make others from them ----


def read_parameters(integrator) -> dict:
    """Read the parameters of a ``nerg`` integrator under the names of its manual page."""
    names = ("occlusion", "radiance", "jitter")
    march = ("step", "dt_gamma", "stop", "color_cutoff", "quadrature", "coarse", "refined")
    out = {n: getattr(integrator, n) for n in names} | {n: getattr(integrator.settings, n) for n in march}
    observer = integrator.observer_settings
    observer_names = (
        "depth",
        "surface_opacity",
        "visibility",
        "tolerance",
        "map_height",
        "directions",
        "integral_tolerance",
    )
    return out | {
        "falloff": float(integrator.falloff[0]),
        **{n: getattr(observer, n) for n in observer_names},
        "headlight": integrator.shading.headlight,
        "background": np.array(integrator.background, float).ravel().tolist(),
    }


def read_splat_extent(integrator) -> float | None:
    """Read the cut-off of the Gaussians in standard deviations; None if the field has no Gaussians."""
    medium = integrator.medium
    return None if medium is None or medium.hits is None else medium.arrays.extent


# ---- Subject ----
#
# A subject is a scene that provides integrators with any parameters, its rays, and its true values.
#
# There are three kinds: analytic scenes and scenes of shapes, with float64 references, and scene files with a field,
# whose reference is a render with much smaller steps.

KINDS = ("auto", "analytic", "file")
AOVS = "depth,opacity,visibility,gaze"
FALLOFF = 0.1
VOXEL_RESOLUTIONS = (256, 512, 1024)
_MAX_VOXEL_BYTES = 2 << 30
REFERENCE_REFINEMENT = 32  # Steps of the reference of a scene file are this many times shorter
# The reference uses no acceleration or early termination.
_REFERENCE_PARAMS = {"coarse": 1.0, "dt_gamma": 0.0, "jitter": False, "color_cutoff": 0.0, "stop": 1e-9} | {
    "quadrature": "constant",
    "refined": False,
    "integral_tolerance": 0.0,
}


@dataclass(frozen=True)
class ExactSurfaces:
    """Exact surfaces of a scene; arrays (N, 3) float64 in scene units.

    ``cast(origins, directions)`` returns distances (N,) along unit rays, inf on a miss; ``is_visible(eye, points)``
    whether (N,) nothing is between them.
    """

    cast: Callable[[np.ndarray, np.ndarray], np.ndarray]
    is_visible: Callable[[np.ndarray, np.ndarray], np.ndarray]


def no_exact_surfaces(scene: Path) -> ExactSurfaces | None:
    """Return None: the exact surfaces of the scene are unknown."""
    return None


def open_subject(
    scene: Any,
    kind: str,
    width: int,
    height: int,
    defaults: Mapping[str, str] | None = None,
    surfaces: Callable[[Path], ExactSurfaces | None] = no_exact_surfaces,
) -> StudySubject:
    """Open an analytic scene by name, a scene file, or a Mitsuba scene.

    Parameters
    ----------
    scene : str, path or mi.Scene
        Name of an analytic scene, path of a scene file, or a scene.
    kind : str
        One of `KINDS`.
    width, height : int
        Size of the picture in pixels.
    defaults : mapping, optional
        Defaults of a scene file.
    surfaces : callable
        Returns the exact surfaces of a scene file, if they are known.

    Raises
    ------
    NergError
        If there is no such scene.
    """
    if kind not in KINDS:
        raise NergError(f'the kind of scene must be one of {", ".join(KINDS)}, got "{kind}"')
    name = str(scene)
    is_analytic = kind == "analytic" or (kind == "auto" and name in SCENES)
    if defaults and (is_analytic or not isinstance(scene, (str, Path))):
        raise NergError(f"{parameter('defaults')} are those of a scene file; pass one, or leave them out")
    if not isinstance(scene, (str, Path)):
        return load_subject(scene, width, height)
    if is_analytic:
        if name not in SCENES:
            raise NergError(f'there is no analytic scene "{scene}": choose one of {", ".join(SCENES)}')
        return AnalyticSubject(SCENES[name], width, height)
    if not Path(scene).exists():
        names = ", ".join(SCENES)
        raise NergError(f'"{scene}" is neither a scene file nor one of the analytic scenes {names}')
    return load_subject(Path(scene), width, height, defaults, surfaces)


class StudySubject:
    """Base class of study subjects.

    Attributes
    ----------
    scene, sensor
        Mitsuba scene and camera.
    size : tuple
        (width, height) in pixels.
    base_params : dict
        Parameters and children of the integrator.
    extent : float
        Diagonal of the medium in scene units.
    tolerance : float
        Tolerance of the visibility. It is fixed, so that all settings have the same true visibility (the default of the
        integrator follows the step).
    """

    name: str
    is_opaque: bool
    has_gaze = True
    is_normalized = False
    """Whether the gaze is divided by an integral."""
    is_marched = True
    """Whether there is a medium that is marched."""
    has_splats = False
    """Whether the medium is Gaussian splats, which are intersected individually."""
    can_resample = False
    """Whether the density is available as a grid of other resolutions."""
    voxel_resolutions: tuple[int, ...] = ()
    """Resolutions to which the field can be compiled."""

    def _set_up(self, scene, sensor, base: dict) -> None:
        self.scene, self.sensor, self.base_params = scene, sensor, base
        self._truths: dict = {}
        first = self.make_integrator()
        self.step = first.settings.step
        if self.is_marched:
            self.extent, self.tolerance = first.medium.length_scale, 2 * self.step
        else:
            self.extent = SceneGeometry(None, scene).shape_diagonal
            self.tolerance = RELATIVE_TOLERANCE * self.extent
        self.base_params = {**base, "tolerance": self.tolerance}

    def make_integrator(self, params: Mapping = {}, resolution: int = 0, voxels: int = 0):
        """Make a ``nerg`` integrator with ``params`` overriding the scene's; ``resolution`` selects the density as a
        grid, ``voxels`` the field compiled to this resolution (one of `voxel_resolutions`).
        """
        import mitsuba as mi

        if resolution:
            raise NergError(f'"{self.name}" is not an analytic scene; only these support a grid resolution')
        compiled = {"field": self.compile_field(voxels)[0]} if voxels else {}
        return mi.load_dict({"type": "nerg", **apply_splat_extent({**self.base_params, **params, **compiled})})

    def compile_field(self, resolution: int) -> tuple[Any, int]:
        """Return the volume of the field compiled to ``resolution``, and the size of its voxels in bytes."""
        raise NergError(f'"{self.name}" has no radiance field that can be compiled')

    def aov_names(self) -> str:
        return AOVS if self.has_gaze else AOVS.replace(",gaze", "")

    def resize(self, width: int, height: int) -> None:
        """Change the picture size; the true values are computed again."""
        import mitsuba as mi

        params = mi.traverse(self.sensor)
        params["film.size"] = params["film.crop_size"] = [width, height]
        params["film.crop_offset"] = [0, 0]
        params.update()
        self.size = (width, height)
        self._truths.clear()

    def record_rays(self, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Return origins and directions (N, 3) float64 of the rays of a render with one sample per pixel."""
        import mitsuba as mi

        class RayRecorder(mi.SamplingIntegrator):
            def aov_names(self):
                return [f"{name}.{c}" for name in "od" for c in "XYZ"]

            def sample(self, scene, sampler, ray, medium=None, active=True):
                return mi.Spectrum(0), mi.Bool(True), [ray.o.x, ray.o.y, ray.o.z, ray.d.x, ray.d.y, ray.d.z]

        picture = self.render(RayRecorder(mi.Properties()), 1, seed)[..., -6:].reshape(-1, 6).astype(float)
        return picture[:, :3], picture[:, 3:]

    def render(self, integrator, spp: int, seed: Any) -> np.ndarray:
        """Render the picture (h, w, channels)."""
        import mitsuba as mi

        return np.array(mi.render(self.scene, integrator=integrator, sensor=self.sensor, spp=spp, seed=seed))

    def render_channels(self, integrator, spp: int, seed: int) -> dict[str, np.ndarray]:
        """Render and return the channels by name: ``color`` (N, 3), and each AOV (N,)."""
        picture = self.render(integrator, spp, seed)
        picture = picture.reshape(-1, picture.shape[-1]).astype(float)
        names = [n.split(".")[0] for n in integrator.aov_names()]
        first = picture.shape[1] - len(names)
        out = {n: picture[:, first + k] for k, n in enumerate(names)}
        return out | {"color": np.broadcast_to(picture[:, :first][:, :3], (len(picture), 3))}

    def get_truth(self, seed: int, depth: str, visibility: str) -> StudyTruth:
        """Return the reference for the rays of ``seed``, for a depth estimator and a kind of visibility."""
        # Refined depths and maps compute the same quantities.
        depth = DEPTHS.find(depth).surface_kind if self.is_marched else ""
        visibility = "transmittance" if visibility == "transmittance" else "depth"
        key = seed, depth, visibility
        if key not in self._truths:
            self._truths[key] = self._compute_truth(*key)
        return self._truths[key]

    def _compute_truth(self, seed: int, depth: str, visibility: str) -> StudyTruth:
        """Compute the reference that `get_truth` caches."""
        raise NotImplementedError

    def find_exact_hits(self, seed: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the exact distances (N,), inf on a miss, and whether the observer sees the surfaces (N,) bool; None if
        unknown.
        """
        raise NotImplementedError


class AnalyticSubject(StudySubject):
    """An analytic scene as the subject of a study."""

    can_resample = True

    def __init__(self, scene: AnalyticScene, width: int, height: int):
        import mitsuba as mi

        self.analytic, self.name, self.is_opaque = scene, scene.name, scene.is_opaque
        self._volumes = make_volumes(scene)
        observer = make_sensor(scene.observer, (0.5, 0.5, 0.5), 40, 1, 1)
        sensor = mi.load_dict(make_sensor(scene.camera, scene.target, scene.fov, width, height))
        self.size = (width, height)
        base = {**self._volumes, "observer": observer, "falloff": FALLOFF, "aovs": AOVS}
        self._set_up(mi.load_dict({"type": "scene", "sensor": sensor}), sensor, base)

    def make_integrator(self, params: Mapping = {}, resolution: int = 0, voxels: int = 0):
        import mitsuba as mi

        if voxels:
            self.compile_field(voxels)
        grid = {"density": make_volumes(self.analytic, resolution)["density"]} if resolution else {}
        return mi.load_dict({"type": "nerg", **self.base_params, **grid, **params})

    def _compute_truth(self, seed: int, depth: str, visibility: str) -> StudyTruth:
        import mitsuba as mi

        o, d = self.record_rays(seed)
        integrator, p_o = self.make_integrator(), mi.Point3f(*self.analytic.observer)
        return compute_truth(
            self.analytic,
            integrator.gaze.for_observers([p_o], SceneGeometry(integrator.medium), integrator.observer_settings),
            o,
            d,
            depth=depth,
            visibility=visibility,
            falloff=FALLOFF,
            tolerance=self.tolerance,
            surface_opacity=0.5,
        )

    def find_exact_hits(self, seed: int):
        if not self.is_opaque:
            return None
        o, d = self.record_rays(seed)
        t = find_first_solid(self.analytic, o, d)
        hit = np.isfinite(t)
        p_o = np.asarray(self.analytic.observer, float)
        offset = o + d * np.where(hit, t, 0)[:, None] - p_o
        distance = np.linalg.norm(offset, axis=-1)
        first_hit = find_first_solid(self.analytic, np.broadcast_to(p_o, o.shape), offset / distance[:, None])
        return t, hit & (first_hit > distance - 1e-6)  # Both distances lead to the same point, but for rounding


class FileSubject(StudySubject):
    """A scene file whose integrator is ``nerg`` and whose first sensor takes the picture.

    ``surfaces`` are its exact surfaces, if known.
    """

    def __init__(self, path: Path, scene, width: int, height: int, surfaces: ExactSurfaces | None = None):
        integrator, sensor = scene.integrator(), scene.sensors()[0]
        self.name = path.stem if path.stem != "scene" else resolve_path(path).parent.name
        self.surfaces, self.is_opaque = surfaces, surfaces is not None
        children = integrator.children
        self.has_gaze, medium = "gaze" in children, integrator.medium
        self.is_normalized = self.has_gaze and integrator.gaze.field.config.normalized
        self.has_splats = medium is not None and medium.hits is not None
        self._compiled: dict[int, tuple[Any, int]] = {}
        if isinstance(medium, FieldMedium) and medium.field.voxels is None:
            fits = lambda resolution: bound_voxel_bytes(medium.field, resolution) <= _MAX_VOXEL_BYTES
            self.voxel_resolutions = tuple(filter(fits, VOXEL_RESOLUTIONS))
        self._set_up(scene, sensor, {**children, **read_parameters(integrator), "aovs": self.aov_names()})
        self.resize(width, height)

    def compile_field(self, resolution: int) -> tuple[Any, int]:
        import mitsuba as mi

        if resolution not in self.voxel_resolutions:
            return super().compile_field(resolution)
        if resolution not in self._compiled:
            volume = self.base_params["field"]
            voxels = compile_density(volume.field, resolution)
            to_world = mi.ScalarTransform4f(volume.medium().to_world.matrix)
            compiled = type(volume).from_network(attach_voxels(volume.field, voxels), to_world)
            self._compiled[resolution] = compiled, voxels.size
        return self._compiled[resolution]

    def observer_position(self) -> np.ndarray:
        """Return the position (3,) of the observer."""
        observer = self.base_params.get("observer")
        return np.array(sensor_center(observer if observer is not None else self.sensor), float).reshape(3)

    def _compute_truth(self, seed: int, depth: str, visibility: str) -> StudyTruth:
        """Render with steps `REFERENCE_REFINEMENT` times shorter, or with Gaussians cut off far out.

        The convergence is the error of a render with steps twice as long, or Gaussians cut off nearer.
        """
        limits = (
            REFERENCE_EXTENTS
            if self.has_splats
            else [{"step": self.step / n} for n in (REFERENCE_REFINEMENT, REFERENCE_REFINEMENT // 2)]
        )
        reference_params = {**_REFERENCE_PARAMS, "depth": depth, "visibility": visibility, "radiance": True}
        fine, half = (
            self.render_channels(self.make_integrator({**reference_params, **limit}), 1, seed) for limit in limits
        )
        truth = StudyTruth(
            **{n: fine[n] for n in ("color", "opacity", "depth", "visibility")},
            gaze=fine.get("gaze", np.zeros(len(fine["depth"]))),
            source=SPLAT_SOURCE
            if self.has_splats
            else f"render with steps of {self.step / REFERENCE_REFINEMENT:.3g} units",
            convergence={},
        )
        return replace(truth, convergence=compute_errors(half, truth))

    def find_exact_hits(self, seed: int):
        if self.surfaces is None:
            return None
        o, d = self.record_rays(seed)
        t = self.surfaces.cast(o, d)
        hit = np.isfinite(t)
        is_visible = np.zeros(len(t), bool)
        # A millimetre in front of the surface, so that the point does not occlude itself.
        is_visible[hit] = self.surfaces.is_visible(self.observer_position(), o[hit] + d[hit] * (t[hit, None] - 1e-3))
        return t, is_visible


class ShapesSubject(FileSubject):
    """A scene file of meshes without a field."""

    is_marched = False

    def __init__(self, path: Path, scene, width: int, height: int):
        self.triangles = extract_triangles(scene)
        self._hits: dict = {}
        self._color = None
        super().__init__(path, scene, width, height)
        self.is_opaque = True

    def resize(self, width: int, height: int) -> None:
        super().resize(width, height)
        self._hits.clear()
        self._color = None

    def find_first_hits(self, seed: int) -> np.ndarray:
        """Return the distances (N,) to the shapes along the rays of ``seed``; inf on a miss."""
        if seed not in self._hits:
            self._hits[seed] = find_first_hit(self.triangles, *self.record_rays(seed))
        return self._hits[seed]

    def _compute_truth(self, seed: int, depth: str, visibility: str) -> StudyTruth:
        if self._color is None:
            self._color = self.render_channels(self.make_integrator({"aovs": ""}), COLOR_SPP, seed + 1)["color"]
        return compute_truth_of_shapes(self, seed, visibility, self._color)

    def find_exact_hits(self, seed: int):
        o, d = self.record_rays(seed)
        t = self.find_first_hits(seed)
        hit = np.isfinite(t)
        distance, r_o = distance_and_direction(self.observer_position(), o + d * np.where(hit, t, 0)[:, None])
        first_hit = find_first_hit(self.triangles, np.broadcast_to(self.observer_position(), o.shape), r_o)
        return t, hit & (first_hit > distance - 1e-6)  # Both distances lead to the same point, but for rounding


def load_subject(
    source: Any,
    width: int,
    height: int,
    defaults: Mapping[str, str] | None = None,
    surfaces: Callable[[Path], ExactSurfaces | None] = no_exact_surfaces,
) -> FileSubject:
    """Load a scene of a field or of shapes from a file, or use a Mitsuba scene; see `open_subject`."""
    path = source if isinstance(source, Path) else Path("scene in memory")
    scene = load_scene(path, defaults) if isinstance(source, Path) else source
    if type(scene).__name__ != "Scene":
        raise NergError(f"a scene must be a file or a Mitsuba scene, got {type(scene).__name__}")
    if not is_nerg(scene.integrator()):
        raise NergError(f'the integrator of "{path}" is not "nerg"; use a scene with this integrator')
    if not scene.sensors():
        raise NergError(f'"{path}" has no sensor; add a camera')
    if not scene.sensors()[0].film().rfilter().is_box_filter():
        raise NergError(
            f'the film of "{path}" has no box filter, which the comparison of depths needs; set its rfilter to "box"'
        )
    if scene.integrator().medium is not None and len(scene.shapes()) > 0:
        raise NergError(f'"{path}" has both a field and shapes, for which there is no reference; study each alone')
    if scene.integrator().ceiling is not None:
        raise NergError(f'"{path}" has a "ceiling", for which there is no reference; remove it')

    if scene.integrator().medium is None:
        return ShapesSubject(path, scene, width, height)
    exact = surfaces(path) if isinstance(source, Path) else None
    return FileSubject(path, scene, width, height, exact)
