"""Gaze fields in memory: loading, what their observers see, and densities of rays for observers at their origins."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError, parameter, sanitize, translate_mitsuba_errors
from nerg_mi.fields.gaze_base import GazeNetwork
from nerg_mi.files.html import Summary
from nerg_mi.files.values import FilePath, to_numbers, to_path
from nerg_mi.formats.fields import load_gaze, matches_checksum, save_gaze
from nerg_mi.maths import vmf
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.maths.transforms import transform_points
from nerg_mi.progress import Progress, Reporter, open_reporter
from nerg_mi.ranges import DIRECTIONS, Range, check_number
from nerg_mi.tracking.dataset import open_rays
from nerg_mi.tracking.rays import Rays, sample_rows

from .arrays import Floats, as_points, as_rays
from .environment import FILES, Environment
from .scene import AnyEnvironment, ObserverSpace, Scene
from .scene_loading import get_array_module
from .trained import TrainedField


@dataclass(frozen=True, eq=False, repr=False)
class GazeField(TrainedField[GazeNetwork]):
    """A gaze field in memory, loaded from a file or returned by `train_gaze`.

    Attributes
    ----------
    environment : Environment or None
        What the observers of the training saw, if it is known. None: the file with the recorded name next to the
        checkpoint.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> gaze = nerg.GazeField.load(files("nerg_mi.scenes.store") / "shoppers.safetensors")
    >>> isinstance(gaze, nerg.GazeField), gaze.kind
    (True, 'gaze')
    """

    environment: Environment | None = None
    _opened: dict[Any, Environment] = field(default_factory=dict, init=False)

    kind = "gaze"

    @staticmethod
    def _read(path: Path, ns: ModuleType) -> tuple[GazeNetwork, dict[str, Any]]:
        return load_gaze(path, ns)

    def _write(self, path: Path, half: bool) -> None:
        save_gaze(self.network, path, dict(self.provenance), half)

    @property
    def members(self) -> int:
        """Number of fields in an ensemble; 1 without one."""
        return len(self.network.members)

    @property
    def held_out(self) -> str | None:
        """The information gain of the cross-validation over participants, in words; None without one."""
        mix = self.provenance.get("mix")
        if not isinstance(mix, Mapping) or not mix.get("folds"):
            return None
        return f"{mix['bits']:+.3f} bits per held-out sample above a position-independent prior"

    def density(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        *,
        environment: AnyEnvironment = None,
        tolerance: float = 0.02,
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
        environment : AnyEnvironment, optional
            What the observers see, in the frame of the field, in memory or as a file. A `Scene` also determines how
            rays are traced, and a ``to_world`` of its gaze field is applied. Default: the environment of the training.
            A field that does not depend on surfaces ignores it.
        tolerance : float
            Relative error up to which a normalised field is integrated over the sphere around each distinct origin
            (0: use the maximum number of directions). The usual error is several times smaller.
        progress : bool, Reporter or None
            None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives
            everything. There is a warning if the environment is not that of the training.

        Returns
        -------
        ndarray of shape (N,), float32
            Density in 1/sr; for an ensemble, the mean of its members.

        Raises
        ------
        NergError
            An argument is invalid, or the field needs surfaces and the environment of its training is not found.

        Notes
        -----
        The integral over all directions is 1 for a field that is normalised over the sphere, as those of the default
        recipe. Other fields only approximate it.

        Distinct origins share kernel launches. In the demo store, 400 samples with distinct origins take 0.9 s of CPU
        time, and ten times this time with ``tolerance=0.005``, the accuracy of `trace`.

        Examples
        --------
        >>> import nerg_mi as nerg
        >>> from importlib.resources import files
        >>> store = files("nerg_mi.scenes.store")
        >>> gaze = nerg.GazeField.load(store / "shoppers.safetensors")  # trained in store.safetensors, next to it
        >>> density = gaze.density((4.4, 2.8, 1.6), [(0, 1, 0), (0, 0, 1)])
        >>> density.shape, bool(density[0] > density[1] > 0)
        ((2,), True)
        """
        from nerg_mi.transport.extrapolation import warn_extrapolation
        from nerg_mi.transport.observer_batch import evaluate_densities
        from nerg_mi.transport.observer_gaze import GazeFieldInstance

        check_number(tolerance, Range(0, 1), "tolerance")
        o, d = as_rays(origins, directions)
        if get_array_module() is not self.network.ns:
            raise NergError(
                f"{self.label} was created with another Mitsuba variant than the active one; "
                "load it again, or set that variant"
            )
        with open_reporter(progress) as reporter, translate_mitsuba_errors():
            space = self._find_space(environment, reporter)
            # A gaze field maps the frame of the rays by its alignment, and a scene may map that of the field.
            matrix = space.to_world.matrix @ read_training_alignment(self.provenance).matrix
            to_scene = Similarity(matrix)
            positions = transform_points(matrix, o.astype(float))
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
        environment: AnyEnvironment = None,
        tolerance: float = 0.02,
        progress: Progress = None,
    ) -> Floats:
        """Compute the log density of recorded rays, for observers at their origins.

        Parameters
        ----------
        rays : Rays or path
            N rays, in the frame of those of the training.
        environment, tolerance, progress
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
        rays = open_rays(rays)
        density = self.density(
            rays.origin, rays.direction, environment=environment, tolerance=tolerance, progress=progress
        )
        return np.log(density)

    def score(
        self,
        rays: Rays | FilePath,
        *,
        max_rays: int = 1000,
        seed: int = 0,
        environment: AnyEnvironment = None,
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
        environment, progress
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
        >>> gaze = nerg.GazeField.load(files("nerg_mi.scenes.store") / "shoppers.safetensors")
        >>> rays = nerg.Rays.from_arrays([[4.4, 2.8, 1.6]] * 2, [[0, 1, 0], [0.2, 1, 0]], times=[0, 1])
        >>> gaze.score(rays) > -2.53
        True
        """
        rays = open_rays(rays)
        if len(rays) == 0:
            raise NergError("there are no rays to score; relax the selection")
        chosen = rays[sample_rows(len(rays), max_rays, seed)] if len(rays) > max_rays else rays
        return float(self.score_samples(chosen, environment=environment, progress=progress).mean(dtype=np.float64))

    def sample(
        self,
        origin: ArrayLike,
        n: int,
        *,
        seed: int = 0,
        num_directions: int = 16_384,
        environment: AnyEnvironment = None,
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
        environment, progress
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
        >>> gaze = nerg.GazeField.load(files("nerg_mi.scenes.store") / "shoppers.safetensors")
        >>> gaze.sample((4.4, 2.8, 1.6), 100).shape
        (100, 3)
        """
        check_number(n, Range(1, 10**9), "n", is_integer=True)
        cells, density = self._density_around(origin, num_directions, environment, progress)
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
        environment: AnyEnvironment = None,
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
        environment, progress
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
        >>> gaze = nerg.GazeField.load(files("nerg_mi.scenes.store") / "shoppers.safetensors")
        >>> regions = gaze.regions((4.4, 2.8, 1.6), levels=(0.5, 0.9))
        >>> regions.inside.shape, bool(regions.solid_angle[0] < regions.solid_angle[1])
        ((2, 16384), True)
        """
        fractions = np.atleast_1d(to_numbers(levels, "levels"))
        for level in fractions.tolist():
            check_number(level, Range(0, 1), "a level of regions")
        cells, density = self._density_around(origin, num_directions, environment, progress)
        order = np.argsort(-density, kind="stable")
        mass = np.cumsum(density[order], dtype=np.float64)
        count = np.searchsorted(mass, fractions * mass[-1]) + 1
        inside = np.zeros((len(fractions), len(cells)), bool)
        for row, k in zip(inside, count):
            row[order[:k]] = True
        threshold = density[order[np.minimum(count, len(cells)) - 1]]
        return GazeRegions(fractions, threshold, inside.sum(axis=1) * 4 * np.pi / len(cells), cells, density, inside)

    def _density_around(
        self, origin: ArrayLike, count: int, environment: AnyEnvironment, progress: Progress
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return ``count`` directions of equal areas (count, 3) around a position, and their densities (count,)."""
        position = as_points(origin, "origin")
        if len(position) != 1:
            raise NergError(f"origin must be one position x, y, z, got {len(position)}")
        check_number(count, DIRECTIONS, "num_directions", is_integer=True)
        directions = fibonacci_directions(count)
        return directions, self.density(position, directions, environment=environment, progress=progress).astype(
            np.float64
        )

    def save(self, path: FilePath, half: bool | None = None) -> Path:
        """Write a checkpoint (.safetensors) atomically, and next to it the environment of the training if that has no
        file. Parameters, returns and errors as for `TrainedField.save`."""
        path = to_path(path)
        saved = replace(self, provenance={**self.provenance, **self._save_environment(path).metadata})
        return super(GazeField, saved).save(path, half)

    def _save_environment(self, path: Path) -> Environment:
        """Write the environment next to the checkpoint ``path``, if it is in memory, and return that of the file."""
        return (
            Environment(None, self.network.box, "none")
            if self.environment is None
            else self.environment.save_beside(path)
        )

    def open_environment(self, environment: AnyEnvironment = None) -> Environment:
        """Open the environment of the training, with its alignment.

        Parameters
        ----------
        environment : AnyEnvironment, optional
            The environment, or ``"hits"`` or ``"none"``, if that is how the field was trained. Default: the one that
            the field knows, or the file with the recorded name next to its own.

        Returns
        -------
        Environment
            The environment.

        Raises
        ------
        NergError
            It is missing, or ``environment`` is not that of the training.
        """
        align = read_training_alignment(self.provenance)
        if isinstance(environment, (str, os.PathLike)) and str(environment) in ("hits", "none"):
            self._check_kind(str(environment))
            environment = None
        if self.provenance.get("geometry") == "none":
            return Environment(None, self.network.box, "none", align=align)
        if environment is None:
            return replace(self._find_environment(), align=align)
        opened = Environment.open(environment)
        if self.is_trained_in(opened) is False:
            name = f'"{opened.path}"' if opened.path is not None else "this environment"
            raise NergError(
                f"{name} is not what {self.label} was trained in; give the right one with {parameter('environment')}"
            )
        return replace(opened, align=align)

    def _check_kind(self, kind: str) -> None:
        """Raise `NergError` unless the field was trained in hit points ("hits"), or without geometry ("none")."""
        is_without, is_from_hits = self.provenance.get("geometry") == "none", "geometry_file" in self.provenance
        if not (is_without if kind == "none" else is_from_hits):
            trained = "none" if is_without else "hits" if is_from_hits else self._recorded().get("file", "another one")
            raise NergError(
                f'{parameter("environment")} is "{kind}", but {self.label} was trained in '
                f'"{sanitize(trained, 80)}", and is evaluated there; leave out {parameter("environment")}'
            )

    def _recorded(self) -> Mapping[str, Any]:
        """Return the record of the environment's file. Raises `NergError` if there is none."""
        entry = find_environment_record(self.provenance)
        if entry is None:
            raise NergError(
                f"{self.label} does not store the geometry that it was trained in; give what its "
                f"observers see with {parameter('environment')}"
            )
        return entry

    def _find_environment(self) -> Environment:
        """Return the environment of the training. Raises `NergError` if it is not known."""
        if self.environment is not None:
            return self.environment
        return self._open(self.find_environment_file())

    def _open(self, environment: AnyEnvironment) -> Environment:
        """Open an environment; that of a file is kept until another one is opened, or the file changes."""
        if not isinstance(environment, (str, os.PathLike)) or not Path(environment).is_file():
            return Environment.open(environment)
        path = Path(environment)
        status = path.stat()
        key = path.resolve(), status.st_mtime_ns, status.st_size
        if key not in self._opened:
            self._opened.clear()
            self._opened[key] = Environment.open(path)
        return self._opened[key]

    def find_environment_file(self) -> Path:
        """Return the file of the training's environment, next to the checkpoint. Raises `NergError` for another one."""
        recorded, remedy = self._recorded(), f"give the one that it was trained in with {parameter('environment')}"
        name = sanitize(recorded.get("file"), 80)
        if self.path is None:
            raise NergError(
                f'the gaze field needs the environment of its training, "{name}", whose folder is not known; {remedy}'
            )
        path = self.path.parent / str(recorded.get("file"))
        if not path.exists():
            raise NergError(f'"{path}", which the field was trained in, does not exist; {remedy}')
        if not matches_checksum(path, recorded.get("sha256")):
            raise NergError(f'"{path}" is not the file that "{self.path}" was trained in; {remedy}')
        return path

    def is_trained_in(self, environment: Environment) -> bool | None:
        """Return whether the field was trained in ``environment``; None if that is not known."""
        recorded = find_environment_record(self.provenance) or {}
        checksum = recorded.get("sha256")
        if environment.path is not None and checksum is not None:
            return matches_checksum(environment.path, checksum)
        if environment.radiance is not None and checksum is not None and environment.radiance.origin == checksum:
            return True  # compiled or refined
        try:
            return self._find_environment().digest == environment.digest
        except NergError:  # there is nothing to compare with
            return None

    def _find_space(self, environment: AnyEnvironment, reporter: Reporter) -> ObserverSpace:
        """Return what observers see: ``environment``, or that of the training."""
        if not self.network.config.needs_surfaces:
            return self._make_space(None)
        if environment is None:
            return self._make_space(self._find_environment().medium)
        if isinstance(environment, Scene):
            return environment.observer_space
        opened = self._open(environment)
        self.warn_environment(opened, reporter)
        return self._make_space(opened.medium)

    def warn_environment(self, opened: Environment, reporter: Reporter) -> None:
        """Warn if ``opened`` is not, or may not be, the environment of the training."""
        name = f'"{opened.path}"' if opened.path is not None else "this environment"
        if self.provenance.get("geometry") == "none":
            reporter.warn(
                f"{self.label} was trained without geometry; the surfaces of {name} are not where it assumes them"
            )
            return
        is_same = self.is_trained_in(opened)
        if is_same is False or (is_same is None and find_environment_record(self.provenance) is not None):
            state = "may not have been" if is_same is None else "was not"
            reporter.warn(
                f"{self.label} {state} trained in {name}; its densities are valid only if surfaces and coordinates "
                "are the same"
            )

    def _make_space(self, medium: Any) -> ObserverSpace:
        """Return a space in the frame of the field, traced as in the training."""
        from nerg_mi.transport.geometry import as_scene_geometry, default_march_settings
        from nerg_mi.transport.observer import ObserverSettings

        scene_geometry = as_scene_geometry(medium)
        settings = ObserverSettings(
            march=default_march_settings(scene_geometry), depth=self.provenance.get("probes", {}).get("depth", "median")
        )
        return ObserverSpace(scene_geometry, settings, Similarity())


@dataclass(frozen=True, eq=False, repr=False)
class GazeRegions(Summary):
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


def read_training_alignment(provenance: Mapping[str, Any]) -> Similarity:
    """Return the transform from the training rays to the scene. Raises `NergError` for a damaged one."""
    return Similarity() if provenance.get("align") is None else Similarity(provenance["align"])


def find_environment_record(provenance: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the name (``file``) and the checksum (``sha256``) of the environment of a gaze field, or None."""
    return next((provenance[file.key] for file in FILES.values() if file.key in provenance), None)
