"""Who looked like that? The position of an observer, from a picture of where they look.

    python examples/recover_observer.py [--eye 4.4,2.8,1.6] [--seed 0] [--out recover-observer.png] [--quick]

The integrator renders the gaze of an observer on what a camera sees. Here the picture is given and the observer is not:
gradient descent through ``mi.render``, with respect to the observer's position, from several places in the store. The given
picture has noise of its own; the descents are judged by their loss alone, and by their distance from the truth afterwards. The edges
of the observer's shadows are no part of the derivative, so that a descent may pass its least loss: that point is its answer.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

OBSERVER = "integrator.observer.to_world"
CAMERA = "7.5, 5.2, 2.7", "3.4, 2.6, 0.6"


@dataclass(frozen=True)
class Settings:
    """``size`` of the picture (width, height), multiples of 8; ``starts`` and ``steps`` of the descent; ``rate`` of Adam at
    first, in metres."""

    size: tuple = (48, 32)
    starts: int = 6
    steps: int = 50
    rate: float = 0.06


QUICK = Settings(size=(32, 24), starts=2, steps=20)


class Picture:
    """Gaze of an observer at a position, as a camera in the demo store sees it."""

    def __init__(self, size, file="shapes.xml"):
        import mitsuba as mi

        from nerg_mi.scenes.store.attention_law import HERE

        self.scene = mi.load_file(str(HERE / file), aovs="gaze", radiance="false")
        self.size = size
        camera, target = ([float(v) for v in text.split(",")] for text in CAMERA)
        self._sensor = {
            "type": "perspective", "fov": 84.0, "near_clip": 0.01,
            "to_world": mi.ScalarTransform4f().look_at(camera, target, [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": size[0], "height": size[1], "rfilter": {"type": "box"},
                     "component_format": "float32", "pixel_format": "rgb"},
        }  # fmt: skip
        # The backward pass of mi.render draws other samples than the forward one, unless there is nothing to draw.
        self.sensor = self.sensor_with({"type": "stratified", "jitter": False, "sample_count": 4})
        self.params = mi.traverse(self.scene)

    def sensor_with(self, sampler: dict):
        import mitsuba as mi

        return mi.load_dict({**self._sensor, "sampler": sampler})

    def at(self, position, sensor=None, seed: int = 0):
        """Gaze (h, w) in 1/sr, TensorXf, of the observer at ``position`` (Point3f); differentiable in it."""
        import mitsuba as mi

        self.params[OBSERVER] = mi.Transform4f().translate(position)
        self.params.update()
        return mi.render(self.scene, self.params, sensor=sensor or self.sensor, seed=seed)[..., 3]

    def given(self, position, seed: int):
        """The picture as it is given: with the noise of 16 random samples a pixel."""
        import mitsuba as mi

        sensor = self.sensor_with({"type": "independent", "sample_count": 16})
        return np.array(self.at(mi.Point3f(*map(float, position)), sensor, seed))


def pooled(picture, factor: int):
    """Means over blocks of ``factor`` x ``factor`` pixels of a TensorXf (h, w)."""
    import drjit as dr

    h, w = picture.shape
    blocks = dr.reshape(picture, (h // factor, factor, w // factor, factor))
    return dr.mean(dr.mean(blocks, axis=3), axis=1)


def distance(picture, given, levels=(1, 2, 4, 8)):
    """Squared Hellinger distances of two pictures, summed over pixels and over blocks of 2, 4 and 8 pixels.

    Roots of densities, so that bright pixels do not drown the others; blocks, because a detail that lies elsewhere than it
    should is then still close to where it belongs.
    """
    import drjit as dr

    total = 0
    for factor in levels:
        a, b = (dr.sqrt(pooled(x, factor) + 1e-4) for x in (picture, given))
        total += dr.mean(dr.square(a - b), axis=None)
    return total


def descend(picture: Picture, given, start, settings: Settings, low, high):
    """Gradient descent with Adam, whose rate falls to 0. Returns positions (steps + 1, 3) and losses (steps + 1,)."""
    import drjit as dr
    import mitsuba as mi

    given = mi.TensorXf(np.asarray(given, np.float32))
    optimizer = mi.ad.Adam(lr=settings.rate, params={"eye": mi.Point3f(*map(float, start))}, beta_1=0.8, beta_2=0.95)
    path, losses = [], []
    for step in range(settings.steps + 1):
        loss = 1e3 * distance(picture.at(optimizer["eye"]), given)
        path.append(np.array(optimizer["eye"]).ravel())
        losses.append(float(loss.array[0]) / 1e3)
        if step == settings.steps:
            break
        optimizer.set_learning_rate(settings.rate * 0.5 * (1 + np.cos(np.pi * step / settings.steps)))
        dr.backward(loss)
        optimizer.step()
        optimizer["eye"] = dr.clip(dr.detach(optimizer["eye"]), mi.Point3f(*low), mi.Point3f(*high))
    return np.array(path), np.array(losses)


def answer(path, losses):
    """The position (3,) of least loss on a descent, and that loss."""
    k = int(np.argmin(losses))
    return path[k], losses[k]


def starting_points(count: int, seed: int) -> np.ndarray:
    """Heads (count, 3) in metres anywhere that one can stand, at an average height."""
    from nerg_mi.scenes.store import layout, shoppers

    place, rng = layout.build(0), np.random.default_rng([seed, 0x0B5E])
    floor = rng.uniform((0, 0), layout.ROOM[:2], (400 * count, 2))
    free = floor[shoppers.floor_clearance(place, floor) > shoppers.BODY][:count]
    return np.column_stack([free, np.full(count, np.mean(shoppers.EYE_HEIGHT))])


def figure(pictures, truth, paths, ends, losses, best: int):
    """The given picture, those of the best descent before and after, and a floor plan with all descents."""
    from matplotlib.figure import Figure

    from nerg_mi.scenes.store import layout

    sheet = Figure(figsize=(8.4, 5.6), layout="constrained")
    axes = sheet.subplot_mosaic([["given", "before", "after"], ["plan", "plan", "loss"]], height_ratios=(1, 1.5))
    top = float(np.percentile(pictures["given"], 99))
    for name, title in (("given", "given"), ("before", "at the best descent's start"), ("after", "at its least loss")):
        shown = axes[name].imshow(pictures[name], cmap="inferno", vmin=0, vmax=top, interpolation="nearest")
        axes[name].set_title(title, fontsize=9)
        axes[name].axis("off")
    sheet.colorbar(shown, ax=axes["after"], label="gaze [1/sr]", shrink=0.8)
    plan = axes["plan"]
    for low, high in layout.build(0).solids:
        plan.add_patch(_rectangle(low, high))
    for n, path in enumerate(paths):
        plan.plot(*path[:, :2].T, "-", lw=1.5 if n == best else 0.8, color=f"C{n}")
        plan.plot(*path[0, :2], "o", ms=5, mfc="none", color=f"C{n}")
        plan.plot(*ends[n][:2], "*", ms=11 if n == best else 7, color=f"C{n}")
        axes["loss"].semilogy(losses[n], color=f"C{n}", lw=1.5 if n == best else 0.8)
    plan.plot(*truth[:2], "+", ms=16, mew=2, color="k")
    plan.set(xlim=(0, 8), ylim=(0, 6), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    plan.set_title("circles: starts, stars: answers, cross: the truth", fontsize=9)
    axes["loss"].set(xlabel="step", title="loss")
    return sheet


def _rectangle(low, high):
    from matplotlib.patches import Rectangle

    return Rectangle(low[:2], *(high - low)[:2], color="0.85", lw=0)


def main(argv=None) -> dict:
    import nerg_mi  # noqa: F401  (chooses the libLLVM)
    import mitsuba as mi

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--eye", default="4.4,2.8,1.6", help="where the observer truly is, in metres")
    parser.add_argument("--seed", type=int, default=0, help="of the noise of the given picture and of the starts")
    parser.add_argument("--out", type=Path, default=Path("recover-observer.png"))
    parser.add_argument("--quick", action="store_true", help="a small picture, few starts and steps: a try in seconds")
    args = parser.parse_args(argv)
    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb")
    from nerg_mi.scenes.store.layout import ROOM
    from nerg_mi.scenes.store.shoppers import EYE_HEIGHT

    settings = QUICK if args.quick else Settings()
    truth = np.array([float(v) for v in args.eye.split(",")])
    picture = Picture(settings.size)
    given = picture.given(truth, args.seed + 1)
    low, high = (0.3, 0.3, EYE_HEIGHT[0] - 0.2), (ROOM[0] - 0.3, ROOM[1] - 0.3, EYE_HEIGHT[1] + 0.2)
    starts, paths, losses = starting_points(settings.starts, args.seed), [], []
    print("start [m]             off [cm]  ->  end [m]               off [cm]  loss")
    for start in starts:
        path, loss = descend(picture, given, start, settings, low, high)
        paths.append(path)
        losses.append(loss)
        end, least = answer(path, loss)
        a, b = (100 * np.linalg.norm(p - truth) for p in (path[0], end))
        print(f"{_text(path[0])}  {a:8.1f}  ->  {_text(end)}  {b:8.1f}  {loss[0]:.5f} -> {least:.5f}", flush=True)
    best = int(np.argmin([x.min() for x in losses]))
    ends = [answer(p, x)[0] for p, x in zip(paths, losses)]
    off = np.array([[100 * np.linalg.norm(p - truth) for p in (path[0], end)] for path, end in zip(paths, ends)])
    print(f"least loss: {_text(ends[best])}, {off[best, 1]:.1f} cm from the observer (before: {off[best, 0]:.1f} cm)")
    print(f"{np.sum(off[:, 1] < 10)} of {len(off)} descents end within 10 cm")

    from nerg_mi.view.figures import save

    pictures = {"given": given}
    for name, p in (("before", paths[best][0]), ("after", ends[best])):
        pictures[name] = np.array(picture.at(mi.Point3f(*map(float, p))))
    save(figure(pictures, truth, paths, ends, losses, best), args.out)
    print(f"wrote {args.out}")
    return {"truth": truth, "paths": paths, "losses": losses, "best": best, "off": off}


def _text(p) -> str:
    return " ".join(f"{v:6.3f}" for v in p)


if __name__ == "__main__":
    main()
