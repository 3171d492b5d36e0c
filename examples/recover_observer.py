"""Who looked like that? The position of an observer, from pictures of where they look.

    python examples/recover_observer.py [--observers 8 | --eye 4.4,2.8,1.6] [--seed 0] [--out recover-observer.png]
    [--quick]

The integrator renders the gaze of an observer on what four cameras see. Here the pictures are given and the observer is
not. First the pictures of observers on a grid over the floor are compared with the given ones; from the best of them
Gauss-Newton steps follow, whose derivatives are those of ``mi.render`` in forward mode: three unknowns, three passes.

The edges of the observer's shadows are no part of these derivatives. A step therefore counts only pixels that are
looked at in both the given picture and the present one, where no edge has passed, and counts those less that fit badly.
Which answer to believe is decided on all pixels. The given pictures have noise of their own; the truth serves to say
how far off an answer is.
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
DARK = 2e-3  # 1/sr under which a pixel counts as not looked at
FLOOR = 1e-3  # 1/sr added before the logarithm is taken
SCALES = 0.5, 0.03  # of residuals (logarithms of densities) that count half, at first and from 60 % of the steps on
LONGEST = 0.25  # metres of a step at most
ENOUGH = 5e-4  # metres of a step after which the descent is over


@dataclass(frozen=True)
class Settings:
    """``size`` of a picture (width, height), multiples of 8; ``spacing`` of the grid of first guesses in metres;
    ``starts`` of them that are improved, by ``steps`` steps at most; ``observers`` to be found."""

    size: tuple = (48, 32)
    spacing: float = 0.4
    starts: int = 2
    steps: int = 10
    observers: int = 8


QUICK = Settings(size=(24, 16), spacing=0.8, steps=6, observers=2)


class Pictures:
    """Gaze of an observer at a position, as cameras in the demo store see it: (cameras, h, w) in 1/sr."""

    def __init__(self, size, cameras=CAMERAS, file="shapes.xml"):
        from nerg_mi.scenes.store.attention_law import FOLDER

        import mitsuba as mi

        self.scene = mi.load_file(str(FOLDER / file), aovs="gaze", radiance="false")
        self.params = mi.traverse(self.scene)
        self.params.keep([OBSERVER])
        self.size, self.cameras = size, cameras
        # Derivatives are rendered with another seed than the picture, unless there is nothing to draw.
        self.sensors = self._sensors({"type": "stratified", "jitter": False, "sample_count": 4})

    def _sensors(self, sampler: dict) -> list:
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
        """The pictures of an observer at ``position`` (3,)."""
        import mitsuba as mi

        rendered = self._render(mi.Point3f(*map(float, position)), sensors or self.sensors, seed)
        return np.array([np.array(image, float) for image in rendered])

    def given(self, position, seed: int) -> np.ndarray:
        """The pictures as they are given: with the noise of 16 random samples a pixel."""
        return self.at(position, self._sensors({"type": "independent", "sample_count": 16}), seed)

    def derivatives(self, position) -> np.ndarray:
        """Derivatives (cameras, h, w, 3) of the pictures with respect to ``position``, by forward mode."""
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
# How far apart pictures are
# ----------------------------------------------------------------------------


def pooled(pictures, factor: int) -> np.ndarray:
    """Means over blocks of ``factor`` x ``factor`` pixels of (..., h, w)."""
    h, w = pictures.shape[-2:]
    return pictures.reshape(*pictures.shape[:-2], h // factor, factor, w // factor, factor).mean((-3, -1))


def distance(a, b, levels=(2, 4, 8)) -> np.ndarray:
    """Squared Hellinger distances of pictures (..., cameras, h, w), summed over blocks of 2, 4 and 8 pixels: bright
    pixels do not drown the others, and a detail that lies elsewhere than it should is still close to where it
    belongs."""
    return sum(((np.sqrt(pooled(a, k)) - np.sqrt(pooled(b, k))) ** 2).mean((-3, -2, -1)) for k in levels)


def loss(pictures, given, scale: float = SCALES[1]) -> float:
    """Mean over all pixels of a robust (Cauchy) function of differences between logarithms of densities."""
    r = np.log(pictures + FLOOR) - np.log(given + FLOOR)
    return float(np.mean(np.log1p((r / scale) ** 2)))


# ----------------------------------------------------------------------------
# The search
# ----------------------------------------------------------------------------


def gauss_newton_step(pictures, derivatives, given, scale: float) -> np.ndarray:
    """The step (3,) in metres that brings ``pictures`` nearer to ``given``, from pixels that are looked at in both."""
    r = np.log(pictures + FLOOR) - np.log(given + FLOOR)
    J = derivatives / (pictures + FLOOR)[..., None]
    w = ((pictures > DARK) & (given > DARK)) / (1 + (r / scale) ** 2)
    J, wJ = J.reshape(-1, 3), (w[..., None] * J).reshape(-1, 3)
    A = J.T @ wJ
    step = np.linalg.solve(A + np.diag(1e-2 * np.diag(A) + 1e-9), -wJ.T @ r.ravel())
    return step * min(1, LONGEST / max(np.linalg.norm(step), 1e-12))


@dataclass
class Descent:
    """Positions of a descent (steps + 1, 3), and the loss of each on all pixels. Its last position is its answer."""

    path: list = field(default_factory=list)
    losses: list = field(default_factory=list)

    def answer(self):
        """The last position, and its loss."""
        return self.path[-1], self.losses[-1]


def descend(pictures: Pictures, given, start, steps: int) -> Descent:
    """Gauss-Newton from ``start`` with at most ``steps`` steps; the scale of residuals falls along the way."""
    found, p = Descent(), np.asarray(start, float)
    for step in range(steps + 1):
        present = pictures.at(p)
        found.path.append(p)
        found.losses.append(loss(present, given))
        if step == steps or (step and np.linalg.norm(p - found.path[-2]) < ENOUGH):
            break
        scale = SCALES[0] * (SCALES[1] / SCALES[0]) ** min(1, step / (0.6 * steps))
        p = np.clip(p + gauss_newton_step(present, pictures.derivatives(p), given, scale), LOW, HIGH)
    return found


def standing(points, clearance: float) -> np.ndarray:
    """Which of the floor's points (N, 2) keep that distance from all furniture and walls."""
    from nerg_mi.scenes.store import layout, shoppers

    return shoppers.compute_floor_clearance(layout.build_store(0), points) > clearance


def first_guesses(spacing: float) -> np.ndarray:
    """Heads (N, 3) of a grid over all of the floor that one can stand on, at an average height."""
    from nerg_mi.scenes.store import layout, shoppers

    x, y = (np.arange(spacing / 2, side, spacing) for side in layout.ROOM[:2])
    floor = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    floor = floor[standing(floor, 0.15)]
    return np.column_stack([floor, np.full(len(floor), np.mean(shoppers.EYE_HEIGHT))])


def true_observers(count: int, seed: int) -> np.ndarray:
    """Heads (count, 3) anywhere that a body can stand, of any height that shoppers have."""
    from nerg_mi.scenes.store import layout, shoppers

    rng = np.random.default_rng([seed, 0x0B5E])
    floor = rng.uniform((0, 0), layout.ROOM[:2], (100 * count, 2))
    heights = rng.uniform(*shoppers.EYE_HEIGHT, count)
    return np.column_stack([floor[standing(floor, shoppers.BODY_RADIUS)][:count], heights])


def search(pictures: Pictures, given, guesses, known, settings: Settings) -> list:
    """Descents from the guesses (N, 3) whose pictures ``known`` (N, cameras, h, w) are nearest to the given ones, best
    first."""
    order = np.argsort(distance(known, given))[: settings.starts]
    found = [descend(pictures, given, guesses[k], settings.steps) for k in order]
    return sorted(found, key=lambda d: d.answer()[1])


# ----------------------------------------------------------------------------
# What is shown
# ----------------------------------------------------------------------------


def figure(shown, truths, searches):
    """The first observer's given pictures, those of the best descent before and after, and a floor plan with all of
    them."""
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
    for name, title in (("given", "given"), ("before", "best first guess"), ("after", "answer")):
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
    plan.set_title("crosses: truth, circles: first guesses, triangles: cameras", fontsize=8)
    off.set(xlabel="step")
    off.set_title("distance from the truth [cm]", fontsize=8)
    return sheet


def main(argv=None) -> dict:
    import mitsuba as mi

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--observers", type=int, help="how many to find, at random places (default: 8)")
    parser.add_argument("--eye", help="where one observer truly is, in metres, in place of random ones")
    parser.add_argument(
        "--seed", type=int, default=0, help="of the random places and of the noise of the given pictures"
    )
    parser.add_argument("--out", type=Path, default=Path("recover-observer.png"))
    parser.add_argument("--quick", action="store_true", help="small pictures, two observers: a try in seconds")
    args = parser.parse_args(argv)
    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb")

    settings = QUICK if args.quick else Settings()
    truths = true_observers(args.observers or settings.observers, args.seed)
    if args.eye:
        truths = np.array([[float(v) for v in args.eye.split(",")]])
    began = time.process_time()
    pictures, guesses = Pictures(settings.size), first_guesses(settings.spacing)
    known = np.array([pictures.at(p) for p in guesses])
    print(f"{len(guesses)} first guesses rendered in {time.process_time() - began:.0f} s of CPU time")
    print("observer [m]          guess off [cm]   answer [m]            off [cm]  loss   steps  CPU [s]")
    searches, off, shown = [], [], None
    for n, truth in enumerate(truths):
        given, began = pictures.given(truth, args.seed + n + 1), time.process_time()
        found = search(pictures, given, guesses, known, settings)
        best = found[0]
        end, least = best.answer()
        searches.append(found)
        off.append([100 * np.linalg.norm(p - truth) for p in (best.path[0], end)])
        shown = shown or {"given": given, "before": pictures.at(best.path[0]), "after": pictures.at(end)}
        print(
            f"{_text(truth)}  {off[-1][0]:12.1f}  ->  {_text(end)}  {off[-1][1]:8.2f}  {least:.4f}  "
            f"{len(best.path) - 1:5}  {time.process_time() - began:7.0f}",
            flush=True,
        )
    off = np.array(off)
    print(
        f"median {np.median(off[:, 1]):.2f} cm, worst {off[:, 1].max():.2f} cm "
        f"(first guesses: median {np.median(off[:, 0]):.1f} cm); {np.sum(off[:, 1] < 10)} of {len(off)} within 10 cm"
    )

    from nerg_mi.figures.style import save

    save(figure(shown, truths, searches), args.out)
    print(f"wrote {args.out}")
    return {"truths": truths, "searches": searches, "off": off}


def _text(p) -> str:
    return " ".join(f"{v:6.3f}" for v in p)


if __name__ == "__main__":
    main()
