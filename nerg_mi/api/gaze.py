"""Gaze fields in memory: loading, and densities of rays for observers at their origins."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.environment.environment import Environment
from nerg_mi.environment.kinds import ENVIRONMENTS, detect_kind
from nerg_mi.environment.trained import TrainedField
from nerg_mi.errors import NergError, sanitize, translate_mitsuba_errors
from nerg_mi.fields.gaze_base import AnyGazeField
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.files.values import FilePath, to_numbers, to_path
from nerg_mi.formats.fields import load_gaze as read_gaze
from nerg_mi.formats.fields import matches_checksum
from nerg_mi.maths import vmf
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.progress import Reporter
from nerg_mi.ranges import DIRECTIONS, Range, check_number
from nerg_mi.rays.rays import Rays, sample_rows
from nerg_mi.rendering.scene import get_array_module

from .arrays import Floats, as_points, as_rays
from .calls import Progress, report_progress
from .objects import as_file, copy_from_session, resolve_rays
from .scene import AnyEnvironment, Scene

if TYPE_CHECKING:
    from nerg_mi.transport.geometry import SceneGeometry
    from nerg_mi.transport.observer import ObserverSettings


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
        geometry: AnyEnvironment = None,
        tolerance: float = 0.01,
        progress: Progress = None,
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
        geometry : AnyEnvironment, optional
            What the observers see, in the frame of the field: a scene, a mesh, a radiance field, a grid, Gaussian
            splats or hit points (.vol), in memory or as a file. A `Scene` also determines how rays are
            traced, and a ``to_world`` of its gaze field is applied. Default: the geometry of the training. A field that
            does not depend on surfaces ignores it.
        tolerance : float
            Relative error up to which a normalised field is integrated over the sphere around each distinct origin
            (0: use the maximum number of directions). The usual error is several times smaller.
        progress : bool, Reporter or None
            None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives
            everything. There is a warning if the geometry is not that of the training.

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
        from nerg_mi.train.geometry_files import read_training_alignment
        from nerg_mi.transport.extrapolation import warn_extrapolation
        from nerg_mi.transport.observer_batch import evaluate_densities
        from nerg_mi.transport.observer_gaze import GazeFieldInstance

        check_number(tolerance, Range(0, 1), "tolerance")
        o, d = as_rays(origins, directions)
        if get_array_module() is not self.network.ns:
            raise NergError(
                f'the gaze field "{self.name}" was created with another Mitsuba variant than the active one; '
                "load it again, or set that variant"
            )
        with report_progress(progress) as reporter, translate_mitsuba_errors():
            space = self._find_space(geometry, reporter)
            # A gaze field maps the frame of the rays by its alignment, and a scene may map that of the field.
            matrix = space.to_world.matrix @ read_training_alignment(dict(self.provenance)).matrix
            to_scene = Similarity(matrix)
            positions = o.astype(float) @ matrix[:3, :3].T + matrix[:3, 3]
            vectors = d.astype(float) @ (matrix[:3, :3] / to_scene.scale).T
            instance = GazeFieldInstance(self.network, space.to_world)
            warn_extrapolation(reporter.warn, space.geometry, instance, np.unique(positions, axis=0))
            return evaluate_densities(
                instance,
                space.geometry,
                replace(space.settings, integral_tolerance=float(tolerance)),
                positions,
                vectors,
                lambda done, count: reporter.progress(done / count, f"observer {done:,} of {count:,}"),
            ).mean(axis=0)

    def score_samples(
        self,
        rays: Rays | FilePath,
        *,
        geometry: AnyEnvironment = None,
        tolerance: float = 0.01,
        progress: Progress = None,
    ) -> Floats:
        """Compute the log density of recorded rays, for observers at their origins.

        Parameters
        ----------
        rays : Rays or path
            N rays, in the frame of those of the training.
        geometry, tolerance, progress
            As for `density`.

        Returns
        -------
        ndarray of shape (N,), float32
            Natural logarithm of the density in 1/sr.

        Raises
        ------
        NergError
            As for `density`.
        """
        rays = _load_rays(rays)
        density = self.density(rays.origin, rays.direction, geometry=geometry, tolerance=tolerance, progress=progress)
        return np.log(density)

    def score(
        self,
        rays: Rays | FilePath,
        *,
        max_rays: int = 1000,
        seed: int = 0,
        geometry: AnyEnvironment = None,
        progress: Progress = None,
    ) -> float:
        """Compute the mean log likelihood of recorded rays, as `GaussianMixture.score` of scikit-learn does.

        Parameters
        ----------
        rays : Rays or path
            The rays, in the frame of those of the training.
        max_rays : int
            Maximum number of rays; of more, a uniform sample is scored, since each position takes some milliseconds.
        seed : int
            Seed of the sample.
        geometry, progress
            As for `density`.

        Returns
        -------
        float
            Mean natural logarithm of the density in 1/sr. A uniform density has -2.53.

        Raises
        ------
        NergError
            There are no rays, or as for `density`.

        Examples
        --------
        >>> import nerg_mi as nerg
        >>> from importlib.resources import files
        >>> gaze = nerg.load_gaze(files("nerg_mi.scenes.store") / "shoppers.safetensors")
        >>> rays = nerg.Rays.from_arrays([[4.4, 2.8, 1.6]] * 2, [[0, 1, 0], [0.2, 1, 0]], times=[0, 1])
        >>> gaze.score(rays) > -2.53
        True
        """
        rays = _load_rays(rays)
        if len(rays) == 0:
            raise NergError("there are no rays to score; relax the selection")
        chosen = rays[sample_rows(len(rays), max_rays, seed)] if len(rays) > max_rays else rays
        return float(self.score_samples(chosen, geometry=geometry, progress=progress).mean(dtype=np.float64))

    def sample(
        self,
        origin: ArrayLike,
        n: int,
        *,
        seed: int = 0,
        num_directions: int = 16_384,
        geometry: AnyEnvironment = None,
        progress: Progress = None,
    ) -> Floats:
        """Draw gaze directions of an observer.

        Parameters
        ----------
        origin : array_like of shape (3,)
            Position of the observer, in the frame of the rays of the training.
        n : int
            Number of directions.
        seed : int
            Seed of the random numbers.
        num_directions : int
            Number of equal cells of the sphere, within which the density counts as constant; 16,384 cells are 1.6
            degrees wide.
        geometry, progress
            As for `density`.

        Returns
        -------
        ndarray of shape (n, 3), float32
            Unit vectors.

        Raises
        ------
        NergError
            As for `density`.

        Examples
        --------
        >>> import nerg_mi as nerg
        >>> from importlib.resources import files
        >>> gaze = nerg.load_gaze(files("nerg_mi.scenes.store") / "shoppers.safetensors")
        >>> gaze.sample((4.4, 2.8, 1.6), 100).shape
        (100, 3)
        """
        check_number(n, Range(1, 10**9), "n", is_integer=True)
        cells, density = self._density_around(origin, num_directions, geometry, progress)
        rng = np.random.default_rng(seed)
        chosen = cells[rng.choice(len(cells), n, p=density / density.sum())]
        # Uniform in a cap with the area of a cell.
        local, (across, up) = _sample_cap(n, 4 * np.pi / len(cells), rng), vmf.tangent_frame(chosen)
        return (local[:, :1] * across + local[:, 1:2] * up + local[:, 2:] * chosen).astype(np.float32)

    def regions(
        self,
        origin: ArrayLike,
        levels: Sequence[float] = (0.5, 0.8),
        *,
        num_directions: int = 16_384,
        geometry: AnyEnvironment = None,
        progress: Progress = None,
    ) -> GazeRegions:
        """Compute the smallest regions of directions that contain given fractions of an observer's gaze.

        Parameters
        ----------
        origin : array_like of shape (3,)
            Position of the observer, in the frame of the rays of the training.
        levels : sequence of float
            Fractions of the gaze, between 0 and 1.
        num_directions : int
            Number of equal cells of the sphere.
        geometry, progress
            As for `density`.

        Returns
        -------
        GazeRegions
            The regions, as masks of directions.

        Raises
        ------
        NergError
            A level is out of range, or as for `density`.

        Examples
        --------
        >>> import nerg_mi as nerg
        >>> from importlib.resources import files
        >>> gaze = nerg.load_gaze(files("nerg_mi.scenes.store") / "shoppers.safetensors")
        >>> regions = gaze.regions((4.4, 2.8, 1.6), levels=(0.5, 0.9))
        >>> regions.inside.shape, bool(regions.solid_angle[0] < regions.solid_angle[1])
        ((2, 16384), True)
        """
        fractions = np.atleast_1d(to_numbers(levels, "levels"))
        for level in fractions.tolist():
            check_number(level, Range(0, 1), "a level of regions")
        cells, density = self._density_around(origin, num_directions, geometry, progress)
        order = np.argsort(-density, kind="stable")
        mass = np.cumsum(density[order], dtype=np.float64)
        count = np.searchsorted(mass, fractions * mass[-1]) + 1
        inside = np.zeros((len(fractions), len(cells)), bool)
        for row, k in zip(inside, count):
            row[order[:k]] = True
        threshold = density[order[np.minimum(count, len(cells)) - 1]]
        return GazeRegions(fractions, threshold, inside.sum(axis=1) * 4 * np.pi / len(cells), cells, density, inside)

    def _density_around(
        self, origin: ArrayLike, count: int, geometry: AnyEnvironment, progress: Progress
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return ``count`` directions of equal areas (count, 3) around a position, and their densities (count,)."""
        position = as_points(origin, "origin")
        if len(position) != 1:
            raise NergError(f"origin must be one position x, y, z, got {len(position)}")
        check_number(count, DIRECTIONS, "num_directions", is_integer=True)
        directions = fibonacci_directions(count)
        return directions, self.density(position, directions, geometry=geometry, progress=progress).astype(np.float64)

    def save(self, path: FilePath, half: bool | None = None) -> Path:
        """Write a checkpoint (.safetensors) atomically, and next to it the environment of the training if that was in
        memory. Parameters, returns and errors as for `TrainedField.save`."""
        path = super().save(path, half)
        if self.geometry_file is not None:
            copy_from_session(self.geometry_file, path.parent)
        return path

    def _find_space(self, geometry: AnyEnvironment, reporter: Reporter) -> _ObserverSpace:
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
        path = as_file(geometry, "geometry")
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
        status = path.stat()
        key = path.resolve(), status.st_mtime_ns, status.st_size
        if key not in self._spaces:
            self._spaces.clear()
            self._spaces[key] = self._make_space(Environment.open(path).medium)
        return self._spaces[key]

    def _find_training_file(self) -> Path:
        """Return the geometry file of the training. Raises `NergError` if there is none."""
        from nerg_mi.train.geometry_files import find_training_file, geometry_key

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
        from nerg_mi.workflows.scene_environments import find_training_scene

        checksum = find_training_scene(dict(self.provenance))
        if checksum is not None and not matches_checksum(path, checksum):
            reporter.warn(
                f'"{self.name}" was not trained in "{path}"; its densities are valid only if surfaces and coordinates '
                "are the same"
            )


@dataclass(frozen=True, eq=False, repr=False)
class GazeRegions:
    """Smallest regions of directions that contain fractions of an observer's gaze.

    Attributes
    ----------
    levels : ndarray of shape (L,)
        Fractions of the gaze.
    threshold : ndarray of shape (L,)
        Smallest density in each region, in 1/sr.
    solid_angle : ndarray of shape (L,)
        Sizes of the regions in sr.
    directions : ndarray of shape (K, 3)
        Unit vectors, which represent equal parts of the sphere.
    density : ndarray of shape (K,)
        Their densities in 1/sr.
    inside : ndarray of shape (L, K), bool
        Whether each direction is in each region.
    """

    levels: np.ndarray
    threshold: np.ndarray
    solid_angle: np.ndarray
    directions: np.ndarray
    density: np.ndarray
    inside: np.ndarray

    def __repr__(self) -> str:
        parts = ", ".join(f"{100 * level:g} % in {size:.3g} sr" for level, size in zip(self.levels, self.solid_angle))
        return f"<GazeRegions: {parts}>"


def _sample_cap(n: int, area: float, rng: np.random.Generator) -> np.ndarray:
    """Return n unit vectors (n, 3) that are uniform in a cap of an ``area`` in sr around z."""
    z = 1 - rng.random(n) * area / (2 * np.pi)
    phi, radius = rng.random(n) * 2 * np.pi, np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=1)


def training_geometry(gaze: object) -> dict[str, Path]:
    """Return the option that names the environment of the training of a gaze field in memory, if it is known."""
    from nerg_mi.train.geometry_files import geometry_key

    if not isinstance(gaze, TrainedGazeField) or gaze.geometry_file is None:
        return {}
    key = geometry_key(gaze.path or Path(gaze.name), dict(gaze.provenance))
    return {{"field_file": "field", "scene_file": "scene", "geometry_file": "geometry"}[key]: gaze.geometry_file}


def _load_rays(rays: object) -> Rays:
    from nerg_mi.rays.dataset import load_rays

    data = resolve_rays(rays)
    return data if isinstance(data, Rays) else load_rays(data)


def list_inputs(inputs: object) -> list[Any]:
    """Return one input or several as a list. If there is a gaze field and no environment, that of its training is
    added, if it is known."""
    is_one = isinstance(inputs, (str, os.PathLike)) or not isinstance(inputs, (list, tuple))
    items = [inputs] if is_one else list(inputs)  # pyright: ignore[reportArgumentType] which is a list or a tuple
    fields = [item for item in items if isinstance(item, TrainedGazeField)]
    others = [item for item in items if not isinstance(item, (TrainedGazeField, Rays))]
    has_environment = any(
        not isinstance(item, (str, os.PathLike)) or (Path(item).exists() and detect_kind(Path(item)) in ENVIRONMENTS)
        for item in others
    )
    if len(fields) == 1 and not has_environment and fields[0].geometry_file is not None:
        items.append(fields[0].geometry_file)
    return items


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
    network, metadata = read_gaze(to_path(path), get_array_module())
    return TrainedGazeField(network, metadata.get("provenance", {}), Path(path).name, Path(path))
