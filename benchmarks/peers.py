"""What other programs do of the same work: SciPy of kernel densities, Mitsuba's own `volpath` of a volume.

Each function gives the works by name, what is alike in them and by how much, for `bench.py`. Nothing is timed before
that is within its bound.
"""

from __future__ import annotations

from collections.abc import Callable

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from nerg_mi.density.kde.estimate import SphericalKde

import numpy as np

Works = dict[str, Callable[[], np.ndarray]]


def unit_vectors(count: int, seed: int) -> np.ndarray:
    """Directions (count, 3), uniform over the sphere."""
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def kernel_densities(rays: int, directions: int, kappa: float = 200.0) -> tuple[Works, float]:
    """A density of ``rays`` kernels in as many ``directions``, and the largest difference relative to the mean."""
    import drjit as dr
    from scipy.special import logsumexp

    mu, x = unit_vectors(rays, 0), unit_vectors(directions, 1)
    ours = SphericalKde(mu, np.array([0, rays]), kappa)
    ns = ours.ns
    where, probe = ns.Array3f(x.T.astype(np.float32)), dr.zeros(ns.UInt32, directions)
    dr.eval(where, probe)
    constant = np.log(kappa / (2 * np.pi * -np.expm1(-2 * kappa)) / rays)

    def with_scipy() -> np.ndarray:
        parts = [logsumexp(kappa * (part @ mu.T - 1), axis=1) for part in np.array_split(x, max(1, directions // 256))]
        return np.exp(constant + np.concatenate(parts))

    def with_nerg() -> np.ndarray:
        return np.array(ours.density(probe, where))

    known, got = with_scipy(), with_nerg()
    return {"nerg": with_nerg, "SciPy": with_scipy}, float(np.max(np.abs(got - known)) / known.mean())


def cloud(cells: int) -> np.ndarray:
    """Densities (z, y, x, 1) of a cloud of balls in an otherwise empty grid, 0 to 6 a unit."""
    at = (np.stack(np.meshgrid(*[np.arange(cells)] * 3, indexing="ij"), -1) + 0.5) / cells
    value = np.zeros((cells,) * 3)
    for center in np.random.default_rng(0).uniform(0.25, 0.75, (12, 3)):
        value = np.maximum(value, 6.0 * np.clip(1.6 - np.linalg.norm(at - center, axis=-1) / 0.1, 0, 1))
    return value[..., None].astype(np.float32)


def transmittances(size: int, samples: int, cells: int = 64) -> tuple[Works, Callable[[np.ndarray], float], float]:
    """How much passes a cloud that only absorbs: by `nerg` (its quadrature, one sample a pixel) and by `volpath`
    (``samples`` a pixel, in a medium of albedo 0 before a white surrounding). The works give pictures (size, size); the
    function their error (root of the mean square) against 16 samples a pixel with steps of a 16th, and the last number
    how far the means of the two are apart."""
    import mitsuba as mi

    grid = {
        "type": "gridvolume",
        "grid": mi.VolumeGrid(cloud(cells)),
        "raw": True,
        "to_world": mi.ScalarTransform4f().translate(-1).scale(2),
    }
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "component_format": "float32"}
    view = mi.ScalarTransform4f().look_at([1.5, 1, -4], [0, 0, 0], [0, 1, 0])
    sensor = {"type": "perspective", "fov": 35, "to_world": view, "film": film}
    fine = 2 * 3**0.5 / 1024 / 16

    def marched(**more):
        integrator = {"type": "nerg", "density": grid, "aovs": "opacity", **more}
        return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor})

    medium = {"type": "heterogeneous", "sigma_t": grid, "albedo": 0.0}
    box = {"type": "cube", "bsdf": {"type": "null"}, "interior": medium}
    traced = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "volpath", "max_depth": 64},
            "sensor": sensor,
            "box": box,
            "sky": {"type": "constant"},
        }
    )
    places = {"nerg": marched(), "exact": marched(step=fine)}

    def passed(scene, spp: int, seed: int = 0) -> np.ndarray:
        return 1 - np.array(mi.render(scene, spp=spp, seed=seed))[..., -1]

    works = {
        "nerg": lambda: passed(places["nerg"], 1),
        f"volpath, {samples} samples": lambda: np.array(mi.render(traced, spp=samples))[..., 0],
    }
    truth = np.mean([passed(places["exact"], 4, seed) for seed in range(4)], axis=0)

    def error(picture: np.ndarray) -> float:
        return float(np.sqrt(np.mean((picture - truth) ** 2)))

    means = [float(work().mean()) for work in works.values()]
    return works, error, abs(means[1] - means[0]) / means[0]
