"""Recover the position of an observer from pictures of their gaze.

    python examples/recover_observer.py [--observers 8 | --eye 4.4,2.8,1.6] [--seed 0] [--out recover-observer.png]
    [--quick]

The integrator renders the gaze of an observer as seen by four cameras. This example solves the inverse problem. First,
the pictures of observers on a grid over the floor are compared with the target pictures. From the best of them,
Gauss-Newton steps follow, with derivatives from ``mi.render`` in forward mode: three unknowns, three passes.

These derivatives do not include the moving edges of the observer's shadows. A step therefore only uses pixels with gaze
in both the target and the current picture, where no edge has passed, and gives outliers less weight. The best solution
is selected on all pixels. The target pictures are noisy; the true position is only used to measure the error.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)

import numpy as np

OBSERVER = "integrator.observer.to_world"
CAMERAS = [(x, y, 2.7) for x in (0.5, 7.5) for y in (0.8, 5.2)]
TARGET = (4.0, 3.0, 0.6)
LOW, HIGH = np.array([0.2, 0.2, 1.3]), np.array([7.8, 5.8, 1.95])
DARK = 2e-3  # 1/sr below which a pixel has no gaze
FLOOR = 1e-3  # 1/sr added before taking the logarithm
SCALES = 0.5, 0.03  # scale of the robust loss of log densities, at first and from 60 % of the steps on
LONGEST = 0.25  # maximum length of a step in metres
ENOUGH = 5e-4  # length of a step in metres at which the descent stops


@dataclass(frozen=True)
class Settings:
    """Settings of the example.

    ``size`` of a picture (width, height), multiples of 8; ``spacing`` of the grid of initial positions in metres;
    ``starts`` is the number of initial positions that are refined, with at most ``steps`` steps; ``observers`` is the
    number of observers.
    """

    size: tuple = (48, 32)
    spacing: float = 0.4
    starts: int = 2
    steps: int = 10
    observers: int = 8


QUICK = Settings(size=(24, 16), spacing=0.8, steps=6, observers=2)


class Pictures:
    """Gaze of an observer as seen by cameras in the demo store: (cameras, h, w) in 1/sr."""

    def __init__(self, size, cameras=CAMERAS, file="shapes.xml"):
        from nerg_mi.scenes.store.attention_law import FOLDER

        import mitsuba as mi

        self.scene = mi.load_file(str(FOLDER / file), aovs="gaze", radiance="false")
        self.params = mi.traverse(self.scene)
        self.params.keep([OBSERVER])
        self.size, self.cameras = size, cameras
        # Derivatives would be rendered with another seed than the picture, so the sampler does not use random numbers.
        self.sensors = self._make_sensors({"type": "stratified", "jitter": False, "sample_count": 4})

    def _make_sensors(self, sampler: dict) -> list:
        import mitsuba as mi

        film = {
            "type": "hdrfilm",
            "width": self.size[0],
            "height": self.size[1],
            "rfilter": {"type": "box"},
            "component_format": "float32",
            "pixel_format": "rgb",
        }
        look = [mi.ScalarTransform4f().look_at(list(c), list(TARGET), [0, 0, 1]) for c in self.cameras]
        common = {"type": "perspective", "fov": 84.0, "near_clip": 0.01, "film": film, "sampler": sampler}
        return [mi.load_dict({**common, "to_world": t}) for t in look]

    def _render(self, position, sensors, seed=0) -> list:
        import mitsuba as mi

        self.params[OBSERVER] = mi.Transform4f().translate(position)
        self.params.update()
        return [mi.render(self.scene, self.params, sensor=s, seed=seed)[..., 3] for s in sensors]

    def at(self, position, sensors=None, seed: int = 0) -> np.ndarray:
        """Render the pictures of an observer at ``position`` (3,)."""
        import mitsuba as mi

        rendered = self._render(mi.Point3f(*map(float, position)), sensors or self.sensors, seed)
        return np.array([np.array(image, float) for image in rendered])

    def reference(self, position, seed: int) -> np.ndarray:
        """The pictures as they are given: with the noise of 16 random samples a pixel."""
        return self.at(position, self._make_sensors({"type": "independent", "sample_count": 16}), seed)

    def derivatives(self, position) -> np.ndarray:
        """Compute the derivatives (cameras, h, w, 3) of the pictures with respect to ``position`` in forward mode."""
        import drjit as dr
        import mitsuba as mi

        columns = []
        for axis in range(3):
            x = mi.Float(0)
            dr.enable_grad(x)
            moved = [mi.Float(float(v)) for v in position]
            moved[axis] += x
            rendered = self._render(mi.Point3f(*moved), self.sensors)
            dr.forward(x)
            columns.append([np.array(dr.grad(image), float) for image in rendered])
        return np.moveaxis(np.array(columns), 0, -1)


# ----------------------------------------------------------------------------
# Distance between pictures
# ----------------------------------------------------------------------------


def pooled(pictures, factor: int) -> np.ndarray:
    """Average over blocks of ``factor`` x ``factor`` pixels of (..., h, w)."""
    h, w = pictures.shape[-2:]
    return pictures.reshape(*pictures.shape[:-2], h // factor, factor, w // factor, factor).mean((-3, -1))


def distance(a, b, levels=(2, 4, 8)) -> np.ndarray:
    """Compute squared Hellinger distances of pictures (..., cameras, h, w), summed over blocks of 2, 4 and 8 pixels.

    Bright pixels do not dominate, and small displacements of details cause small distances.
    """
    return sum(((np.sqrt(pooled(a, k)) - np.sqrt(pooled(b, k))) ** 2).mean((-3, -2, -1)) for k in levels)


def loss(pictures, reference, scale: float = SCALES[1]) -> float:
    """Compute the mean over all pixels of a robust (Cauchy) function of the difference of log densities."""
    r = np.log(pictures + FLOOR) - np.log(reference + FLOOR)
    return float(np.mean(np.log1p((r / scale) ** 2)))


# ----------------------------------------------------------------------------
# The search
# ----------------------------------------------------------------------------


def gauss_newton_step(pictures, derivatives, reference, scale: float) -> np.ndarray:
    """Compute the Gauss-Newton step (3,) in metres, from pixels with gaze in both pictures."""
    r = np.log(pictures + FLOOR) - np.log(reference + FLOOR)
    J = derivatives / (pictures + FLOOR)[..., None]
    w = ((pictures > DARK) & (reference > DARK)) / (1 + (r / scale) ** 2)
    J, wJ = J.reshape(-1, 3), (w[..., None] * J).reshape(-1, 3)
    A = J.T @ wJ
    step = np.linalg.solve(A + np.diag(1e-2 * np.diag(A) + 1e-9), -wJ.T @ r.ravel())
    return step * min(1, LONGEST / max(np.linalg.norm(step), 1e-12))


@dataclass
class Descent:
    """Positions of a descent (steps + 1, 3), and the loss of each on all pixels. The last position is the result."""

    path: list = field(default_factory=list)
    losses: list = field(default_factory=list)

    def answer(self):
        """The last position and its loss."""
        return self.path[-1], self.losses[-1]


def descend(pictures: Pictures, reference, start, steps: int) -> Descent:
    """Run Gauss-Newton from ``start`` with at most ``steps`` steps; the scale of the robust loss decreases along the
    way.
    """
    descent, p = Descent(), np.asarray(start, float)
    for step in range(steps + 1):
        present = pictures.at(p)
        descent.path.append(p)
        descent.losses.append(loss(present, reference))
        if step == steps or (step and np.linalg.norm(p - descent.path[-2]) < ENOUGH):
            break
        scale = SCALES[0] * (SCALES[1] / SCALES[0]) ** min(1, step / (0.6 * steps))
        p = np.clip(p + gauss_newton_step(present, pictures.derivatives(p), reference, scale), LOW, HIGH)
    return descent


def standing(points, clearance: float) -> np.ndarray:
    """Return which floor points (N, 2) have this distance to all furniture and walls."""
    from nerg_mi.scenes.store import layout, shoppers

    return shoppers.compute_floor_clearance(layout.build_store(0), points) > clearance


def first_guesses(spacing: float) -> np.ndarray:
    """Return head positions (N, 3) on a grid over the walkable floor, at average height."""
    from nerg_mi.scenes.store import layout, shoppers

    x, y = (np.arange(spacing / 2, side, spacing) for side in layout.ROOM[:2])
    floor = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    floor = floor[standing(floor, 0.15)]
    return np.column_stack([floor, np.full(len(floor), np.mean(shoppers.EYE_HEIGHT))])


def true_observers(count: int, seed: int) -> np.ndarray:
    """Return random head positions (count, 3) on the walkable floor, with the heights of shoppers."""
    from nerg_mi.scenes.store import layout, shoppers

    rng = np.random.default_rng([seed, 0x0B5E])
    floor = rng.uniform((0, 0), layout.ROOM[:2], (100 * count, 2))
    heights = rng.uniform(*shoppers.EYE_HEIGHT, count)
    return np.column_stack([floor[standing(floor, shoppers.BODY_RADIUS)][:count], heights])


def search(pictures: Pictures, reference, guesses, truth, settings: Settings) -> list:
    """Run descents from the guesses (N, 3) with the pictures nearest to the target, sorted by loss."""
    order = np.argsort(distance(truth, reference))[: settings.starts]
    descents = [descend(pictures, reference, guesses[k], settings.steps) for k in order]
    return sorted(descents, key=lambda d: d.answer()[1])


# ----------------------------------------------------------------------------
# Figure and output
# ----------------------------------------------------------------------------


def figure(shown, truths, searches):
    """Draw the target pictures of the first observer, those of the best descent before and after, and a floor plan with
    all descents.
    """
    from nerg_mi.scenes.store import layout

    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    sheet = Figure(figsize=(9, 6.4), layout="constrained")
    axes = sheet.subplot_mosaic(
        [["given"] * 2, ["before"] * 2, ["after"] * 2, ["plan", "off"]],
        height_ratios=(1, 1, 1, 3),
        width_ratios=(1.25, 1),
    )
    top = float(np.percentile(shown["given"], 99))
    for name, title in (("given", "target"), ("before", "best initial position"), ("after", "result")):
        axes[name].imshow(
            np.concatenate(shown[name], axis=1), cmap="inferno", vmin=0, vmax=top, interpolation="nearest"
        )
        axes[name].set_ylabel(title, fontsize=8)
        axes[name].set(xticks=[], yticks=[])
    plan, off = axes["plan"], axes["off"]
    for low, high in layout.build_store(0).solids:
        plan.add_patch(Rectangle(low[:2], *(high - low)[:2], color="0.85", lw=0))
    for n, (truth, descents) in enumerate(zip(truths, searches)):
        for k, descent in enumerate(descents):
            path = np.array(descent.path)
            plan.plot(*path[:, :2].T, ".-", ms=3, lw=0.8, color=f"C{n}", alpha=1 if k == 0 else 0.4)
            plan.plot(*path[0, :2], "o", ms=5, mfc="none", color=f"C{n}", alpha=1 if k == 0 else 0.4)
            off.semilogy(100 * np.linalg.norm(path - truth, axis=1), color=f"C{n}", alpha=1 if k == 0 else 0.4)
        plan.plot(*truth[:2], "+", ms=12, mew=1.5, color="k")
    for x, y, _ in CAMERAS:
        plan.plot(x, y, "^", ms=6, color="0.3")
    plan.set(xlim=(0, 8), ylim=(0, 6), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    plan.set_title("crosses: truth, circles: initial positions, triangles: cameras", fontsize=8)
    off.set(xlabel="step")
    off.set_title("error [cm]", fontsize=8)
    return sheet


def main(argv=None) -> dict:
    import mitsuba as mi

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--observers", type=int, help="number of observers, at random positions (default: 8)")
    parser.add_argument("--eye", help="true position of one observer in metres, instead of random ones")
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the positions and of the noise of the target pictures (default: 0)"
    )
    parser.add_argument("--out", type=Path, default=Path("recover-observer.png"), help="output picture")
    parser.add_argument(
        "--quick", action="store_true", help="use small pictures and two observers, to finish in seconds"
    )
    args = parser.parse_args(argv)
    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb")

    settings = QUICK if args.quick else Settings()
    truths = true_observers(args.observers or settings.observers, args.seed)
    if args.eye:
        truths = np.array([[float(v) for v in args.eye.split(",")]])
    began = time.process_time()
    pictures, guesses = Pictures(settings.size), first_guesses(settings.spacing)
    initial_pictures = np.array([pictures.at(p) for p in guesses])
    print(f"{len(guesses)} initial positions rendered in {time.process_time() - began:.0f} s of CPU time")
    print("observer [m]        initial error [cm]  result [m]          error [cm]  loss   steps  CPU [s]")
    searches, errors, shown = [], [], None
    for n, truth in enumerate(truths):
        target, began = pictures.reference(truth, args.seed + n + 1), time.process_time()
        descents = search(pictures, target, guesses, initial_pictures, settings)
        best = descents[0]
        end, min_loss = best.answer()
        searches.append(descents)
        errors.append([100 * np.linalg.norm(p - truth) for p in (best.path[0], end)])
        shown = shown or {"given": target, "before": pictures.at(best.path[0]), "after": pictures.at(end)}
        print(
            f"{_text(truth)}  {errors[-1][0]:12.1f}  ->  {_text(end)}  {errors[-1][1]:8.2f}  {min_loss:.4f}  "
            f"{len(best.path) - 1:5}  {time.process_time() - began:7.0f}",
            flush=True,
        )
    errors = np.array(errors)
    print(
        f"median {np.median(errors[:, 1]):.2f} cm, worst {errors[:, 1].max():.2f} cm "
        f"(initial positions: median {np.median(errors[:, 0]):.1f} cm); "
        f"{np.sum(errors[:, 1] < 10)} of {len(errors)} within 10 cm"
    )

    from nerg_mi.figures.style import save

    save(figure(shown, truths, searches), args.out)
    print(f"wrote {args.out}")
    return {"truths": truths, "searches": searches, "off": errors}


def _text(p) -> str:
    return " ".join(f"{v:6.3f}" for v in p)


if __name__ == "__main__":
    main()
