"""What a study measures: a scene at many settings, rendered and compared with its true values."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.safe_read import resolve_path
from nerg_mi.rendering.bands import is_nerg
from nerg_mi.rendering.scene import load_scene
from nerg_mi.transport.depth import DEPTHS
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.observer import sensor_center
from nerg_mi.transport.occlusion import RELATIVE_TOLERANCE

from .study_scenes import SCENES, AnalyticScene, make_sensor, make_volumes
from .study_truth import (
    COLOR_SPP,
    REFERENCE_EXTENTS,
    SPLAT_SOURCE,
    StudyTruth,
    compute_truth,
    compute_truth_of_shapes,
    apply_splat_extent,
    compute_errors,
    find_first_hit,
    find_first_solid,
    distance_and_direction,
    extract_triangles,
)

# ---- The settings of an integrator, read back so that another one can be made of them ----


def read_parameters(integrator) -> dict:
    """The parameters of an integrator of type ``nerg``, read back by the names of its manual page."""
    names = ("occlusion", "radiance", "jitter")
    march = ("step", "dt_gamma", "stop", "color_cutoff", "quadrature", "coarse", "refined")
    out = {n: getattr(integrator, n) for n in names} | {n: getattr(integrator.settings, n) for n in march}
    observer = integrator.observer_settings
    seen = ("depth", "surface_opacity", "visibility", "tolerance", "map_height", "directions", "integral_tolerance")
    return out | {
        "falloff": float(integrator.falloff[0]),
        **{n: getattr(observer, n) for n in seen},
        "background": np.array(integrator.background, float).ravel().tolist(),
    }


def read_splat_extent(integrator) -> float | None:
    """Where the Gaussians of its field are cut off, in standard deviations; None where its field is none of these."""
    medium = integrator.medium
    return None if medium is None or medium.hits is None else medium.arrays.extent


# ---- Subject ----
#
# What is studied: a scene of which integrators with any parameters can be made, its rays, and its truth.
#
# Three kinds: analytic scenes and scenes of shapes, with float64 references, and scene files with a field, whose
# reference is a render with much smaller steps.

KINDS = ("auto", "analytic", "file")
AOVS = "depth,opacity,visibility,gaze"
FALLOFF = 0.1
REFERENCE_REFINEMENT = 32  # The reference of a scene file has steps this many times shorter than the scene's own
# Nothing is skipped, merged or cut short in a reference.
_CONVERGED = {"coarse": 1.0, "dt_gamma": 0.0, "jitter": False, "color_cutoff": 0.0, "stop": 1e-9} | {
    "quadrature": "constant",
    "refined": False,
    "integral_tolerance": 0.0,
}


@dataclass(frozen=True)
class ExactSurfaces:
    """Where the surfaces of a place exactly are; arrays (N, 3) float64, in scene units. ``cast(origins, directions)``:
    distances (N,) along unit rays, inf on a miss; ``visible(eye, points)``: whether (N,) nothing lies between."""

    cast: Callable[[np.ndarray, np.ndarray], np.ndarray]
    is_visible: Callable[[np.ndarray, np.ndarray], np.ndarray]


def no_exact_surfaces(scene: Path) -> ExactSurfaces | None:
    """Of scene files of whose surfaces nothing is known."""
    return None


def open_subject(
    scene: str,
    kind: str,
    width: int,
    height: int,
    defaults: Mapping[str, str] | None = None,
    surfaces: Callable[[Path], ExactSurfaces | None] = no_exact_surfaces,
) -> StudySubject:
    """The scene called, or in the file, ``scene``, with a picture of ``width`` x ``height`` pixels.

    ``kind``: one of `KINDS`; ``defaults``: of a scene file; ``surfaces``: what is known of the surfaces that the field
    in a scene file stands for. Raises NergError for what the user can mend.
    """
    if kind not in KINDS:
        raise NergError(f'there is no kind of scene "{kind}": choose one of {", ".join(KINDS)}')
    if kind == "analytic" or (kind == "auto" and scene in SCENES):
        if scene not in SCENES:
            raise NergError(f'there is no analytic scene "{scene}": choose one of {", ".join(SCENES)}')
        return AnalyticSubject(SCENES[scene], width, height)
    if not Path(scene).exists():
        names = ", ".join(SCENES)
        raise NergError(f'there is no scene file "{scene}", and no analytic scene of that name; those are {names}')
    return load_subject(Path(scene), width, height, defaults or {}, surfaces)


class StudySubject:
    """Common to all kinds. ``scene``: `mi.Scene`; ``sensor``; ``size``: (width, height) in pixels; ``base``: the
    integrator's parameters and children; ``extent``: diagonal of the medium in scene units; ``tolerance``: fixed, so
    that all settings answer the same question of visibility (the integrator's own default follows the step)."""

    name: str
    is_opaque: bool
    has_gaze = True
    is_normalized = False
    """Whether that gaze is divided by an integral."""
    is_marched = True
    """Whether there is a medium, whose marching can be set."""
    has_splats = False
    """Whether that is Gaussian splats, which are met one by one."""
    can_resample = False
    """Whether its density can be had as a grid of other resolutions."""

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

    def make_integrator(self, params: Mapping = {}, resolution: int = 0):
        """A ``nerg`` integrator with ``params`` over the scene's own; ``resolution``: density as a grid."""
        import mitsuba as mi

        if resolution:
            raise NergError(f'"{self.name}" has no grids of other resolutions; only analytic scenes do')
        return mi.load_dict({"type": "nerg", **apply_splat_extent({**self.base_params, **params})})

    def aov_names(self) -> str:
        return AOVS if self.has_gaze else AOVS.replace(",gaze", "")

    def resize(self, width: int, height: int) -> None:
        """Another picture size from now on; its truth is found anew."""
        import mitsuba as mi

        params = mi.traverse(self.sensor)
        params["film.size"] = params["film.crop_size"] = [width, height]
        params["film.crop_offset"] = [0, 0]
        params.update()
        self.size = (width, height)
        self._truths.clear()

    def record_rays(self, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Origins and directions (N, 3) float64 of the rays that a render with one sample a pixel traces."""
        import mitsuba as mi

        class Recorder(mi.SamplingIntegrator):
            def aov_names(self):
                return [f"{name}.{c}" for name in "od" for c in "XYZ"]

            def sample(self, scene, sampler, ray, medium=None, active=True):
                return mi.Spectrum(0), mi.Bool(True), [ray.o.x, ray.o.y, ray.o.z, ray.d.x, ray.d.y, ray.d.z]

        picture = self.render(Recorder(mi.Properties()), 1, seed)[..., -6:].reshape(-1, 6).astype(float)
        return picture[:, :3], picture[:, 3:]

    def render(self, integrator, spp: int, seed: Any) -> np.ndarray:
        """The picture (h, w, channels)."""
        import mitsuba as mi

        return np.array(mi.render(self.scene, integrator=integrator, sensor=self.sensor, spp=spp, seed=seed))

    def render_channels(self, integrator, spp: int, seed: int) -> dict[str, np.ndarray]:
        """A render as columns: ``color`` (N, 3), and each AOV (N,)."""
        picture = self.render(integrator, spp, seed)
        picture = picture.reshape(-1, picture.shape[-1]).astype(float)
        names = [n.split(".")[0] for n in integrator.aov_names()]
        first = picture.shape[1] - len(names)
        out = {n: picture[:, first + k] for k, n in enumerate(names)}
        return out | {"color": np.broadcast_to(picture[:, :first][:, :3], (len(picture), 3))}

    def get_truth(self, seed: int, depth: str, visibility: str) -> StudyTruth:
        """The reference for the rays of ``seed``, for kinds of depth (where something is marched) and visibility as the
        integrator names them."""
        # Refined depths and maps are ways to find the same answers.
        depth = DEPTHS.find(depth).surface_kind if self.is_marched else ""
        visibility = "transmittance" if visibility == "transmittance" else "depth"
        key = seed, depth, visibility
        if key not in self._truths:
            self._truths[key] = self._find_truth(*key)
        return self._truths[key]

    def _find_truth(self, seed: int, depth: str, visibility: str) -> StudyTruth:
        """What `truth` keeps."""
        raise NotImplementedError

    def find_exact_hits(self, seed: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Where surfaces are exactly, and whether the observer sees them exactly: (N,) distances, inf on a miss, and
        (N,) bool. None where that is not known."""
        raise NotImplementedError


class AnalyticSubject(StudySubject):
    """An analytic scene."""

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

    def make_integrator(self, params: Mapping = {}, resolution: int = 0):
        import mitsuba as mi

        grid = {"density": make_volumes(self.analytic, resolution)["density"]} if resolution else {}
        return mi.load_dict({"type": "nerg", **self.base_params, **grid, **params})

    def _find_truth(self, seed: int, depth: str, visibility: str) -> StudyTruth:
        import mitsuba as mi

        o, d = self.record_rays(seed)
        made, p_o = self.make_integrator(), mi.Point3f(*self.analytic.observer)
        return compute_truth(
            self.analytic,
            made.gaze.for_observers([p_o], SceneGeometry(made.medium), made.observer_settings),
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
        eye = np.asarray(self.analytic.observer, float)
        offset = o + d * np.where(hit, t, 0)[:, None] - eye
        distance = np.linalg.norm(offset, axis=-1)
        met = find_first_solid(self.analytic, np.broadcast_to(eye, o.shape), offset / distance[:, None])
        return t, hit & (met > distance - 1e-6)  # Both distances lead to the same point, but for rounding


class FileSubject(StudySubject):
    """A scene file whose integrator is ``nerg`` and whose first sensor takes the picture.

    ``surfaces``: where its surfaces exactly are; None where that is not known.
    """

    def __init__(self, path: Path, loaded, width: int, height: int, surfaces: ExactSurfaces | None = None):
        integrator, sensor = loaded.integrator(), loaded.sensors()[0]
        self.name = path.stem if path.stem != "scene" else resolve_path(path).parent.name
        self.surfaces, self.is_opaque = surfaces, surfaces is not None
        children = integrator.children
        self.has_gaze, medium = "gaze" in children, integrator.medium
        self.is_normalized = self.has_gaze and integrator.gaze.field.config.normalized
        self.has_splats = medium is not None and medium.hits is not None
        self._set_up(loaded, sensor, {**children, **read_parameters(integrator), "aovs": self.aov_names()})
        self.resize(width, height)

    def observer_position(self) -> np.ndarray:
        """Where the observer stands (3,)."""
        observer = self.base_params.get("observer")
        return np.array(sensor_center(observer if observer is not None else self.sensor), float).reshape(3)

    def _find_truth(self, seed: int, depth: str, visibility: str) -> StudyTruth:
        """A render with steps `FINER` times shorter, or with Gaussians cut off far out, and how far one with steps
        twice as long, or Gaussians cut off nearer, is from it."""
        limits = REFERENCE_EXTENTS if self.has_splats else [{"step": self.step / n} for n in (REFERENCE_REFINEMENT, REFERENCE_REFINEMENT // 2)]
        kinds = {**_CONVERGED, "depth": depth, "visibility": visibility, "radiance": True}
        fine, half = (self.render_channels(self.make_integrator({**kinds, **limit}), 1, seed) for limit in limits)
        known = StudyTruth(
            **{n: fine[n] for n in ("color", "opacity", "depth", "visibility")},
            gaze=fine.get("gaze", np.zeros(len(fine["depth"]))),
            source=SPLAT_SOURCE if self.has_splats else f"render with steps of {self.step / REFERENCE_REFINEMENT:.3g} units",
            convergence={},
        )
        return replace(known, convergence=compute_errors(half, known))

    def find_exact_hits(self, seed: int):
        if self.surfaces is None:
            return None
        o, d = self.record_rays(seed)
        t = self.surfaces.cast(o, d)
        hit = np.isfinite(t)
        seen = np.zeros(len(t), bool)
        # A millimetre before the surface: the point itself must not hide itself.
        seen[hit] = self.surfaces.is_visible(self.observer_position(), o[hit] + d[hit] * (t[hit, None] - 1e-3))
        return t, seen


class ShapesSubject(FileSubject):
    """A scene file of meshes and no field."""

    is_marched = False

    def __init__(self, path: Path, loaded, width: int, height: int):
        self.triangles = extract_triangles(loaded)
        self._hits: dict = {}
        self._color = None
        super().__init__(path, loaded, width, height)
        self.is_opaque = True

    def resize(self, width: int, height: int) -> None:
        super().resize(width, height)
        self._hits.clear()
        self._color = None

    def find_first_hits(self, seed: int) -> np.ndarray:
        """Distances (N,) to the shapes along the rays of ``seed``; inf on a miss."""
        if seed not in self._hits:
            self._hits[seed] = find_first_hit(self.triangles, *self.record_rays(seed))
        return self._hits[seed]

    def _find_truth(self, seed: int, depth: str, visibility: str) -> StudyTruth:
        if self._color is None:
            self._color = self.render_channels(self.make_integrator({"aovs": ""}), COLOR_SPP, seed + 1)["color"]
        return compute_truth_of_shapes(self, seed, visibility, self._color)

    def find_exact_hits(self, seed: int):
        o, d = self.record_rays(seed)
        t = self.find_first_hits(seed)
        hit = np.isfinite(t)
        distance, r_o = distance_and_direction(self.observer_position(), o + d * np.where(hit, t, 0)[:, None])
        met = find_first_hit(self.triangles, np.broadcast_to(self.observer_position(), o.shape), r_o)
        return t, hit & (met > distance - 1e-6)  # Both distances lead to the same point, but for rounding


def load_subject(
    path: Path,
    width: int,
    height: int,
    defaults: Mapping[str, str],
    surfaces: Callable[[Path], ExactSurfaces | None] = no_exact_surfaces,
) -> FileSubject:
    """The scene in the file ``path``, of a field or of shapes; as `open_subject` has it."""
    loaded = load_scene(path, defaults)
    if not is_nerg(loaded.integrator()):
        raise NergError(f'the integrator of "{path}" is not "nerg": name a scene whose integrator is')
    if not loaded.sensors():
        raise NergError(f'"{path}" has no sensor: add the camera that takes the pictures')
    if not loaded.sensors()[0].film().rfilter().is_box_filter():
        raise NergError(
            f'the film of "{path}" does not have a box filter, without which depths cannot be compared: give it one'
        )
    if loaded.integrator().medium is not None and len(loaded.shapes()) > 0:
        raise NergError(f'"{path}" holds a field and shapes, of which there is no reference: study each alone')
    if loaded.integrator().ceiling is not None:
        raise NergError(f'"{path}" has a "ceiling", of which there is no reference: take it out')
    if loaded.integrator().medium is None:
        return ShapesSubject(path, loaded, width, height)
    return FileSubject(path, loaded, width, height, surfaces(path))
