"""A place where nobody was tracked yet: what the salience of its pictures says, in the one place that has pictures.

    OPENBLAS_NUM_THREADS=1 python benchmarks/prior_salience.py [--folds 4] [--out out/benchmarks/prior_salience]

The demo store's radiance field is rendered from every position that is scored, in sixteen overlapping views of 82 x 66
degrees; the spectral residual of each (Hou & Zhang 2007), in the view's own mean, is what the view says of its
directions, and the mean of those that show a direction is the salience there. That to a power, normalised over the
sphere, is scored as `gaze_prior.py` scores: alone, and times the elevation that people of other places have, which
`nerg train prior` makes. No power can be chosen in another place, since no other has pictures: all are told. Bits are
beyond the uniform density; intervals are 95 % of a bootstrap over the people who are scored.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from gaze_prior import REAL
from output import print_table, write_rows
from place_rays import makers, parse, place_parser
from prior_cases import prior_place
from prior_law import LOG_UNIFORM, normalised
from prior_scores import Scored, summarise
from salience_views import look

import numpy as np

POWERS = (0.25, 0.5, 1.0)
WIDTH, HEIGHT, FOCAL = 128, 96, 74.0
# Elevations (degrees) of the views, and how many each has around.
VIEWS = ((0.0, 8), (-50.0, 4), (50.0, 4))
# Of a salience in its view's mean: nothing is certain to be unseen.
LEAST = 0.02


def main(argv=None) -> None:
    from nerg_mi.jobs.backend import select_backend

    args = parse(place_parser(__doc__, "prior_salience", folds=4, choose=False), argv)
    select_backend("llvm_ad_rgb", args.threads)
    known = makers(args.data)
    elevation = elevation_of([known[name] for name in REAL if name in known], args.out)
    place, found = prior_place("store", known["store"], args.folds, args.out / "store"), []
    for k, fold in enumerate(place.folds):
        maps = np.broadcast_to(fold.test.directions, (len(fold.at), *fold.test.directions.shape))
        log = [[] for _ in range(2)]
        for p, centre in enumerate(fold.test.centres):
            views = views_at(centre)
            for out, directions in zip(log, (maps[p], fold.at[p])):
                out.append(np.log(np.maximum(salience(views, directions), LEAST)))
        of_views = tuple(map(np.stack, log))
        of_people = tuple(elevation(d[..., 2]) for d in (maps, fold.at))
        put = lambda name, logs, k=k, fold=fold: found.append(Scored.of(name, 0, k, fold.test, logs))
        put("uniform", tuple(np.full(v.shape, LOG_UNIFORM) for v in of_views))
        put("elevation of other places", of_people)
        for a in POWERS:
            put(f"salience^{a:g}", normalised(*(a * v for v in of_views)))
            put(f"elevation x salience^{a:g}", normalised(*(a * v + e for v, e in zip(of_views, of_people))))
    rows = summarise("store", found)
    write_rows(args.out / "prior_salience.csv", rows)
    told = [
        (
            r["method"],
            f"{r['KLD']:.3f}",
            f"{r['CC']:.3f}",
            f"{r['bits']:.2f} ({r['bits.low']:.2f} to {r['bits.high']:.2f})",
        )
        for r in rows
    ]
    print_table("Salience of pictures as a prior, in the store", ("density", "KLD", "CC", "bits"), told)


def elevation_of(places: list, folder: Path):
    """Log density (1/sr) by the sine of the elevation, of people in the other ``places``."""
    from nerg_mi.rays.rays import Rays
    from nerg_mi.training.gaze.prior import elevation_density

    rays = []
    for k, make in enumerate(places):
        own = folder / f"other{k}"
        own.mkdir(exist_ok=True)
        rays.append(Rays.load(make(own)[0]))
    sine = np.linspace(-1, 1, 1025)
    log = np.log(elevation_density(rays, sine))
    return lambda z: np.interp(z, sine, log)


def views_at(eye: np.ndarray) -> list:
    """What a model of salience says of the pictures that the store's field shows around ``eye``, as `SalienceView`."""
    from nerg_mi.capture.cameras import Camera
    from nerg_mi.capture.intrinsics import Intrinsics
    from nerg_mi.capture.salience.solid_angle import pixel_solid_angles
    from nerg_mi.capture.salience.spectral_residual import spectral_residual
    from nerg_mi.capture.salience.views import SalienceView

    views = []
    for up, count in VIEWS:
        for turn in range(count):
            pose = look(eye, 2 * np.pi * turn / count, -np.radians(up))
            share = spectral_residual(np.clip(picture(pose), 0, 1) ** (1 / 2.2))
            h, w = share.shape
            lens = Intrinsics(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2).resized(w, h)
            views.append(SalienceView("", Camera(lens, pose), share / share.sum(), pixel_solid_angles(lens)))
    return views


@cache
def shop():
    """The store's field as a scene."""
    import nerg_mi as nerg
    from nerg_mi.jobs import demo

    return nerg.make_scene(nerg.load_field(demo.store_scene().parent / "store.safetensors"))


def picture(pose: np.ndarray) -> np.ndarray:
    """Linear colours (H, W, 3) of the store's field, from a camera-to-world ``pose`` (4, 4; OpenGL)."""
    import nerg_mi as nerg

    eye, field_of_view = pose[:3, 3], 2 * np.degrees(np.arctan(WIDTH / 2 / FOCAL))
    camera = nerg.Camera(eye.tolist(), (eye - pose[:3, 2]).tolist(), fov=field_of_view, width=WIDTH, height=HEIGHT)
    return np.asarray(nerg.render(shop(), quantities=["color"], camera=camera, spp=4).color[0])


def salience(views: list, directions: np.ndarray) -> np.ndarray:
    """Mean (D,) of those ``views`` that show a direction of (D, 3), each in its own mean; 1 where none does."""
    total, count = np.zeros(len(directions)), np.zeros(len(directions))
    for view in views:
        density, known = view.look_up(directions)
        total += np.where(known, density * view.extent, 0)
        count += known
    return np.where(count > 0, total / np.maximum(count, 1), 1.0)


if __name__ == "__main__":
    main()
