"""Gaze fields in memory: loading, and densities of rays for observers at their origins."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from numpy.typing import ArrayLike

from nerg_mi.errors import NergError, sanitize, translate_mitsuba_errors
from nerg_mi.fields.gaze_base import AnyGazeField
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.formats.fields import load_gaze as read_gaze
from nerg_mi.formats.fields import matches_checksum
from nerg_mi.maths.geometry import Similarity
from nerg_mi.ranges import Range, check_number
from nerg_mi.workflows.base import SILENT, Reporter

from .arrays import Floats, as_rays
from .scene import FilePath, Scene, TrainedField, as_path, get_array_module, resolve_file

if TYPE_CHECKING:
    from nerg_mi.transport.geometry import SceneGeometry
    from nerg_mi.transport.observer import ObserverSettings

Geometry: TypeAlias = "FilePath | Scene | TrainedField[RadianceField]"
"""What observers see: a file, a scene, or a radiance field in memory."""


@dataclass(frozen=True)
class _ObserverSpace:
    """What observers see, and how their rays are traced: the geometry, the settings, and the similarity from the frame
    of the gaze field to that of the geometry."""

    geometry: SceneGeometry
    settings: ObserverSettings
    to_world: Similarity


@dataclass(frozen=True, eq=False, repr=False)
class TrainedGazeField(TrainedField[AnyGazeField]):
    """A gaze field in memory.

    Attributes
    ----------
    geometry_file : Path or None
        The scene, mesh or radiance field of the training, if it is known. None: the file with the recorded name next to
        the checkpoint.
    """

    geometry_file: Path | None = None
    _spaces: dict[Any, _ObserverSpace] = field(default_factory=dict, init=False)

    def density(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        *,
        geometry: Geometry | None = None,
        tolerance: float = 0.01,
        reporter: Reporter = SILENT,
    ) -> Floats:
        """Compute the gaze density of rays for observers at their origins, in all directions.

        In contrast to the quantity ``gaze`` of `trace`, which is 0 where no surface is met, the density covers the
        whole sphere, so that ``np.log(density).mean()`` is the log likelihood of the rays (nats of 1/sr).

        Parameters
        ----------
        origins : array_like of shape (N, 3) or (3,)
            Positions of the observers, in the frame of the rays of the training: the alignment of the field is applied.
        directions : array_like of shape (N, 3) or (3,)
            Directions of any length except zero, in the same frame.
        geometry : path, Scene or TrainedField, optional
            What the observers see, in the frame of the field: a scene, a mesh, a radiance field, Gaussian splats or hit
            points (.vol) as a file, or a scene or a radiance field in memory. A `Scene` also determines how rays are
            traced, and a ``to_world`` of its gaze field is applied. Default: the geometry of the training. A field that
            does not depend on surfaces ignores it.
        tolerance : float
            Relative error up to which a normalised field is integrated over the sphere around each distinct origin
            (0: use the maximum number of directions). The usual error is several times smaller.
        reporter : Reporter
            Receives the progress, and a warning if the geometry is not that of the training.

        Returns
        -------
        ndarray of shape (N,), float32
            Density in 1/sr; for an ensemble, the mean of its members.

        Raises
        ------
        NergError
            An argument is invalid, or the field needs surfaces and the geometry of its training is not found.

        Notes
        -----
        The integral over all directions is 1 for a field that is normalised over the sphere, as those of the default
        recipe. Other fields only approximate it.

        Distinct origins share kernel launches. In the demo store, 400 samples with distinct origins take 4 s of CPU
        time, and twice this time with ``tolerance=0.005``, the accuracy of `trace`.

        Examples
        --------
        >>> import nerg_mi as nerg
        >>> from importlib.resources import files
        >>> store = files("nerg_mi.scenes.store")
        >>> gaze = nerg.load_gaze(store / "shoppers.safetensors")  # trained in store.safetensors, next to it
        >>> density = gaze.density((4.4, 2.8, 1.6), [(0, 1, 0), (0, 0, 1)])
        >>> density.shape, bool(density[0] > density[1] > 0)
        ((2,), True)
        """
        from nerg_mi.transport.observer_batch import evaluate_densities
        from nerg_mi.transport.observer_gaze import GazeFieldInstance
        from nerg_mi.workflows.geometry import read_training_alignment

        check_number(tolerance, Range(0, 1), "tolerance")
        o, d = as_rays(origins, directions)
        if get_array_module() is not self.network.ns:
            raise NergError(
                f'the gaze field "{self.name}" was created with another Mitsuba variant than the active one; '
                "load it again, or set that variant"
            )
        with translate_mitsuba_errors():
            space = self._find_space(geometry, reporter)
            # A gaze field maps the frame of the rays by its alignment, and a scene may map that of the field.
            matrix = space.to_world.matrix @ read_training_alignment(dict(self.provenance)).matrix
            to_scene = Similarity(matrix)
            positions = o.astype(float) @ matrix[:3, :3].T + matrix[:3, 3]
            vectors = d.astype(float) @ (matrix[:3, :3] / to_scene.scale).T
            return evaluate_densities(
                GazeFieldInstance(self.network, space.to_world),
                space.geometry,
                replace(space.settings, integral_tolerance=float(tolerance)),
                positions,
                vectors,
                lambda done, count: reporter.progress(done / count, f"observer {done:,} of {count:,}"),
            ).mean(axis=0)

    def _find_space(self, geometry: Geometry | None, reporter: Reporter) -> _ObserverSpace:
        """Return what observers see: ``geometry``, or that of the training."""
        from nerg_mi.transport.field_medium import FieldMedium

        if not self.network.config.needs_surfaces:
            return self._make_space(None)
        if geometry is None:
            return self._load_space(self._find_training_file())
        if isinstance(geometry, Scene):
            gaze, settings = geometry.integrator.gaze, geometry.integrator.observer_settings
            return _ObserverSpace(geometry.geometry, settings, Similarity() if gaze is None else gaze.to_world)
        if isinstance(geometry, TrainedField) and isinstance(geometry.network, RadianceField):
            return self._make_space(FieldMedium(geometry.network))
        if not isinstance(geometry, (str, os.PathLike)):
            raise NergError(
                "geometry must be a file, a Scene or a radiance field of load_field or train_radiance, "
                f"got {type(geometry).__name__}"
            )
        path = resolve_file(geometry, "geometry")
        self._compare(path, reporter)
        return self._load_space(path)

    def _make_space(self, medium: Any) -> _ObserverSpace:
        """Return a space in the frame of the field, traced as in the training."""
        from nerg_mi.train.gaze_data import SURFACE_OPACITY
        from nerg_mi.transport.geometry import as_scene_geometry, default_march_settings
        from nerg_mi.transport.observer import ObserverSettings

        scene_geometry = as_scene_geometry(medium)
        settings = ObserverSettings(
            march=default_march_settings(scene_geometry),
            depth=self.provenance.get("probes", {}).get("depth", "median"),
            surface_opacity=SURFACE_OPACITY,
        )
        return _ObserverSpace(scene_geometry, settings, Similarity())

    def _load_space(self, path: Path) -> _ObserverSpace:
        """Return the space of a geometry file; the last one is cached until the file changes."""
        from nerg_mi.train import geometry
        from nerg_mi.workflows.scene_places import PLACES, detect_kind

        status = path.stat()
        key = path.resolve(), status.st_mtime_ns, status.st_size
        if key not in self._spaces:
            kind = detect_kind(path)
            if kind not in PLACES:
                raise NergError(
                    f'the geometry "{path}" contains {"rays" if kind == "rays" else "a gaze field"}; give a scene, '
                    "a mesh, a radiance field, splats or a volume of hit points (.vol)"
                )
            if kind == "field":
                loaded = geometry.load_field_geometry(path, self.network.ns)
            elif kind == "hits":
                loaded = geometry.load_volume_geometry(path)
            else:
                loaded = geometry.load_scene_geometry(path)
            self._spaces.clear()
            self._spaces[key] = self._make_space(loaded.medium)
        return self._spaces[key]

    def _find_training_file(self) -> Path:
        """Return the geometry file of the training. Raises `NergError` if there is none."""
        from nerg_mi.workflows.geometry import find_training_file, geometry_key

        provenance, remedy = dict(self.provenance), "pass the file that it was trained in with geometry="
        checkpoint = self.path or Path(self.name)
        try:
            recorded = provenance[geometry_key(checkpoint, provenance)]
        except NergError as error:
            raise NergError(f"{error}; pass what its observers see with geometry=") from error
        if self.path is None and self.geometry_file is None:
            raise NergError(
                f'the gaze field needs the geometry of its training, "{sanitize(recorded.get("file"), 80)}", whose '
                f"folder is not known; {remedy}"
            )
        return find_training_file(checkpoint, provenance, self.geometry_file, remedy, remedy)

    def _compare(self, path: Path, reporter: Reporter) -> None:
        """Warn if the field was not trained in the geometry ``path``."""
        from nerg_mi.workflows.scene_places import find_training_scene

        checksum = find_training_scene(dict(self.provenance))
        if checksum is not None and not matches_checksum(path, checksum):
            reporter.warn(
                f'"{self.name}" was not trained in "{path}"; its densities are valid only if surfaces and coordinates '
                "are the same"
            )


def load_gaze(path: FilePath) -> TrainedGazeField:
    """Load a gaze field or an ensemble of gaze fields.

    Parameters
    ----------
    path : path
        A checkpoint written by ``nerg train gaze``, `train_gaze` or ``nerg import``.

    Returns
    -------
    TrainedGazeField
        The field, for `make_scene`; its method ``density`` returns densities of rays.

    Raises
    ------
    NergError
        The file does not exist, is damaged, or contains something else.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> gaze = nerg.load_gaze(store / "shoppers.safetensors")
    >>> gaze.kind
    'gaze'
    """
    network, metadata = read_gaze(as_path(path), get_array_module())
    return TrainedGazeField(network, metadata.get("provenance", {}), Path(path).name, Path(path))
