"""Gaze weights trained further through ``mi.render``, from pictures of gaze and from batches of rays: errors before and
after.

    python benchmarks/gradients_finetune.py [--steps 40] [--size 32x24] [--update docs/gradients.md]

The demo store's shoppers come to look at one shelf up to three times as much (Gaussian, 0.6 m): that is the gaze to be
learnt, known only as pictures of four observers from two cameras each. Errors are relative (L2 over pixels): of these
pictures, of another camera's pictures of the same observers, and of its picture of another observer. Both ways start
from the store's own gaze field and see as many pixels a step. Nothing passes or fails here.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit)
from output import print_table

import drjit as dr
import mitsuba as mi
import numpy as np

STORE = Path(__file__).parents[1] / "scenes" / "store" / "scene.xml"
SHELF, WIDTH = (4.8, 5.5, 1.4), 0.6
OBSERVERS, OTHER = ((4.4, 2.8, 1.6), (6.3, 3.0, 1.6), (3.6, 4.7, 1.6), (6.0, 4.6, 1.6)), (5.0, 4.6, 1.6)
CAMERAS = (((7.4, 3.4, 2.2), (4.8, 5.5, 1.2)), ((4.4, 2.8, 1.6), (4.8, 5.5, 1.2)))
HELD_OUT = (((6.0, 4.6, 1.7), (4.8, 5.5, 1.2)),)


@dataclass
class View:
    """Gaze of an observer at ``eye`` in the picture of a camera; ``target`` (h, w)."""

    eye: tuple
    sensor: object
    target: np.ndarray


class Store:
    """The scene, whose gaze learns."""

    def __init__(self, size: tuple[int, int]):
        width, height = size
        self.scene = mi.load_file(str(STORE), width=width, height=height, aovs="gaze,position", radiance=False)
        self.params = mi.traverse(self.scene)
        self.weights = [key for key in self.params.keys() if key.startswith("integrator.gaze.")]
        self.start = {key: type(self.params[key])(self.params[key]) for key in self.weights}
        self.cameras = {pose: camera(pose, size) for pose in CAMERAS + HELD_OUT}
        self.views = {
            "views trained on": self.views_of(OBSERVERS, CAMERAS),
            "another camera": self.views_of(OBSERVERS, HELD_OUT),
            "and another observer": self.views_of([OTHER], HELD_OUT),
        }

    @property
    def seen(self) -> list[View]:
        return self.views["views trained on"]

    def views_of(self, eyes, poses) -> list[View]:
        found = []
        for eye, pose in product(eyes, poses):
            self.stand(eye)
            picture = np.array(mi.render(self.scene, sensor=self.cameras[pose], spp=1))
            away = np.square(picture[..., 4:7] - np.array(SHELF)).sum(axis=-1)
            found.append(View(eye, self.cameras[pose], picture[..., 3] * (1 + 2 * np.exp(-away / (2 * WIDTH**2)))))
        return found

    def stand(self, eye) -> None:
        self.params["integrator.observer.to_world"] = mi.Transform4f().translate(list(eye))
        self.params.update()

    def errors(self) -> list[float]:
        """Relative error of each group of views."""
        out = []
        for views in self.views.values():
            got = []
            for view in views:
                self.stand(view.eye)
                got.append(np.array(mi.render(self.scene, sensor=view.sensor, spp=1))[..., 3])
            truth = np.array([view.target for view in views])
            out.append(float(np.linalg.norm(np.array(got) - truth) / np.linalg.norm(truth)))
        return out

    def train(self, batches, steps: int, lr: float) -> None:
        """Adam over all gaze weights, from the store's own on. ``batches(i)``: eye, sensor, target (Float, one a
        pixel)."""
        self.params.update(self.start)
        opt = mi.ad.Adam(lr=lr, params=self.start)
        scale = 1 / float(np.mean([np.square(view.target).mean() for view in self.seen]))
        for i in range(steps):
            eye, sensor, target = batches(i)
            self.params.update(opt)
            self.stand(eye)
            picture = mi.render(self.scene, self.params, sensor=sensor, spp=1, seed=i)
            dr.backward(scale * dr.mean(dr.square(picture[..., 3].array - target)))
            opt.step()
        self.params.update(opt)

    def whole_views(self):
        views = self.seen

        def batch(i):
            view = views[i % len(views)]
            return view.eye, view.sensor, mi.Float(view.target.ravel())

        return batch

    def batches_of_rays(self, size):
        """Random pixels of all cameras at once; one loader an observer, as all rays of a batch have one."""
        loaders = []
        for eye in OBSERVERS:
            views = [view for view in self.seen if view.eye == eye]
            colors = [mi.TensorXf(np.repeat(view.target[..., None], 3, axis=-1).astype(np.float32)) for view in views]
            loaders.append(
                mi.ad.loaders.RayDataLoader(
                    [view.sensor for view in views],
                    colors,
                    pixels_per_batch=size[0] * size[1],
                    regular_reshuffle=True,
                    tile_size=1,
                )
            )

        def batch(i):
            target, rays = loaders[i % len(OBSERVERS)].next()
            return OBSERVERS[i % len(OBSERVERS)], rays, target[..., 0].array

        return batch


def camera(pose, size):
    film = {
        "type": "hdrfilm",
        "width": size[0],
        "height": size[1],
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": 78,
            "near_clip": 0.01,
            "film": film,
            "to_world": mi.ScalarTransform4f().look_at(*map(list, pose), [0, 0, 1]),
            "sampler": {"type": "stratified", "jitter": False, "sample_count": 1},
        }
    )


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=40, help="of Adam")
    parser.add_argument("--lr", type=float, default=2e-3, help="learning rate")
    parser.add_argument("--size", default="32x24", help="pixels of a view, width x height")
    parser.add_argument("--update", type=Path, help="a document whose table is replaced")
    args = parser.parse_args(argv)
    mi.set_variant("llvm_ad_rgb")
    size = tuple(int(n) for n in args.size.split("x"))
    store = Store(size)
    rows = []
    for name in ("before", "whole views", "batches of rays"):
        if name != "before":
            batches = store.whole_views() if name == "whole views" else store.batches_of_rays(size)
            store.train(batches, args.steps, args.lr)
        rows.append([name, *(f"{e:.1%}" for e in store.errors())])
        print(rows[-1], file=sys.stderr, flush=True)
    print_table("Errors of gaze", ["", *store.views], rows, args.update)


if __name__ == "__main__":
    main()
