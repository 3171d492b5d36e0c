"""Where along a shelf a product is looked at most: gradient ascent on the attention that its surface receives.

    python examples/place_product.py [--shelf gondola_1_west] [--seed 0] [--out place-product.png] [--quick]

A box stands at the front edge of a shelf of the demo store. Synthetic shoppers pass; the gaze field says where they
look. The expected share of their looks that lands on the box is an integral over the box's own points
(``nerg_mi.probes.surface_attention``), so that its derivative with respect to the box's position comes from automatic
differentiation through distance, direction, gaze networks and fall-off. The box climbs from several starts; a
brute-force sweep along the whole shelf checks where it arrives, and central differences check its derivatives. Not
differentiated: the moving edges of what else hides the box. What that leaves out is measured.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)

import numpy as np

SIZE = (0.24, 0.12, 0.25)  # along, into and above the shelf, metres
JUTS_OUT = 0.06  # metres that the box stands in front of the shelf's edge
STEP = 2.5e-3  # metres of a central difference
SWITCH = 0.25  # relative change of a seen solid angle over two such steps that only an edge can make


@dataclass(frozen=True)
class Settings:
    """``observers`` of the stream; ``divisions`` of each triangle of the box; ``spacing`` of the sweep in metres;
    ``starts`` and ``steps`` of the ascent; ``checks``: positions at which derivatives are compared; ``pixels``: metres
    a pixel of the picture."""

    observers: int = 256
    divisions: int = 4
    spacing: float = 0.02
    starts: int = 5
    steps: int = 50
    checks: int = 24
    pixels: float = 0.02


QUICK = Settings(observers=48, divisions=2, spacing=0.1, starts=2, steps=20, checks=4, pixels=0.1)


def stream(count: int, seed: int) -> np.ndarray:
    """Head positions (count, 3) in metres of shoppers at random moments of their visits."""
    from nerg_mi.scenes.store import attention_law, layout, shoppers

    place = layout.build_store(0)
    store, rng = shoppers.WaypointGraph(place), np.random.default_rng([seed, 0xB0C5])
    weights = 0.5 + attention_law.AttentionLaw().attractiveness
    visits = [shoppers.simulate_visit(store, rng, int(rng.integers(8, 21)), weights).head for _ in range(max(2, count // 16))]
    heads = np.concatenate(visits)
    return heads[rng.choice(len(heads), count, replace=False)]


class Shelf:
    """The board of a shelf's eye-catchers, and a box on it. Scalars along the shelf are world coordinates in metres."""

    def __init__(self, name: str):
        from nerg_mi.scenes.store.attention_law import read_regions

        everywhere = read_regions()
        regions = [r for r in everywhere if r["name"].startswith(name)]
        if not regions:
            known = ", ".join(r["name"] for r in everywhere)
            raise SystemExit(f'There is no shelf "{name}"; regions of the store are {known}.')
        facing = np.array(regions[0]["facing"], float)
        self.axis = int(np.argmax(np.abs(facing)))  # out of the shelf
        self.along, self.sign = 1 - self.axis, int(facing[self.axis])
        low, high = np.min([r["min"] for r in regions], 0), np.max([r["max"] for r in regions], 0)
        self.low, self.high = low, high
        self.front = (high if self.sign > 0 else low)[self.axis]
        self.center = np.zeros(3)
        self.center[self.axis] = self.front + self.sign * (JUTS_OUT - 0.5 * SIZE[1])
        self.center[2] = regions[0]["focus"]["min"][2] + 5e-3 + 0.5 * SIZE[2]
        margin = 0.04 + 0.5 * SIZE[0]  # the shelf's ends are panels of 4 cm
        self.range = low[self.along] + margin, high[self.along] - margin

    def box(self, at: float = 0.0) -> dict:
        """The box as a Mitsuba shape."""
        import mitsuba as mi

        half, center = np.empty(3), self.center.copy()
        half[[self.along, self.axis, 2]] = np.array(SIZE) / 2
        center[self.along] = at
        return {
            "type": "cube",
            "to_world": mi.ScalarTransform4f().translate(center.tolist()).scale(half.tolist()),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.9, 0.9, 0.9]}},
        }


class Attention:
    """Expected attention of a stream of observers to a box on a shelf, and its derivative."""

    def __init__(self, shelf: Shelf, heads: np.ndarray, settings: Settings, falloff: float = 0.05):
        from nerg_mi.probes.surface_attention import make_patches
        from nerg_mi.scenes.store.attention_law import FOLDER
        from nerg_mi.transport.geometry import SceneGeometry

        import mitsuba as mi

        self.shelf, self.falloff = shelf, falloff
        self.scene = mi.load_file(str(FOLDER / "shapes.xml"))
        integrator, self.place = self.scene.integrator(), SceneGeometry(None, self.scene)
        each = [mi.Point3f(*head) for head in heads.tolist()]
        self.gaze = integrator.gaze.for_observers(each, self.place, integrator.observer_settings)
        self.observers = mi.Point3f(np.ascontiguousarray(heads.T, np.float32))
        self.surface = make_patches(mi.load_dict(shelf.box()), settings.divisions)

    def density(self, p_od, p_o, r_o, active):
        return self.gaze.evaluate(p_od, p_o, r_o, active)[0]

    def _each(self, at, density):
        from nerg_mi.probes.surface_attention import attention_per_patch

        import mitsuba as mi

        offset = [mi.Float(0)] * 3
        offset[self.shelf.along] = at
        return attention_per_patch(self.place, density, self.observers, self.surface.translate(mi.Vector3f(offset)), self.falloff)

    def expected(self, at):
        """Attention (Float) with the box at ``at`` (Float) along the shelf: a probability, at any moment of a visit."""
        import drjit as dr

        return dr.sum(self._each(at, self.density)) / dr.width(self.observers)

    def value(self, at: float) -> float:
        import drjit as dr
        import mitsuba as mi

        return float(self.expected(dr.opaque(mi.Float, at))[0])

    def climb(self, start: float, steps: int, rate: float = 0.04) -> np.ndarray:
        """Positions (steps + 1,) of gradient ascent from ``start`` with Adam, whose rate falls to 0, inside of the
        shelf."""
        import drjit as dr
        import mitsuba as mi

        optimizer = mi.ad.Adam(lr=rate, params={"at": mi.Float(start)}, beta_1=0.8, beta_2=0.95)
        path = [start]
        for step in range(steps):
            optimizer.set_learning_rate(rate * 0.5 * (1 + np.cos(np.pi * step / steps)))
            # Adam does not depend on the scale of what it minimises; 1e3 keeps its epsilon out of it.
            dr.backward(-1e3 * self.expected(optimizer["at"]))
            optimizer.step()
            optimizer["at"] = dr.clip(dr.detach(optimizer["at"]), *self.shelf.range)
            path.append(float(optimizer["at"][0]))
        return np.array(path)

    def derivatives(self, at: float) -> np.ndarray:
        """At ``at``: by automatic differentiation and by central differences, of the whole integral; and both again
        without the pairs of observer and patch between which an edge passes; and the share of such pairs. (5,)"""
        import drjit as dr
        import mitsuba as mi

        def solid_angle(p_od, p_o, r_o, active):
            return mi.Float(1)

        ends = [dr.opaque(mi.Float, at + s * STEP) for s in (1, -1)]
        wide = [self._each(x, solid_angle) for x in ends]
        still = dr.abs(wide[0] - wide[1]) <= SWITCH * dr.maximum(wide[0], wide[1])
        looks = [self._each(x, self.density) for x in ends]
        people, out = dr.width(self.observers), []
        for mask in (mi.Bool(True), still):
            x = dr.opaque(mi.Float, at)
            dr.enable_grad(x)
            dr.backward(dr.sum(dr.select(mask, self._each(x, self.density), 0)) / people)
            difference = dr.sum(dr.select(mask, looks[0] - looks[1], 0)) / people
            out += [float(dr.grad(x)[0]), float(difference[0]) / (2 * STEP)]
        return np.array([*out, 1 - float(dr.mean(mi.Float(still))[0])])


def uphill(values: np.ndarray, start: int, window: int = 2) -> int:
    """Index of the local maximum that is reached from ``start`` by going to the best of ``window`` neighbours a
    side."""
    while True:
        low = max(start - window, 0)
        best = low + int(np.argmax(values[low : start + window + 1]))
        if best == start:
            return start
        start = best


def elevation(attention: Attention, at: float, spacing: float):
    """The shelf seen from the front with the box at ``at``: albedo (h, w, 3), attention (h, w) in 1/m², extent in
    metres."""
    from nerg_mi.probes.surface_attention import Patches, attention_per_patch
    from nerg_mi.scenes.store.attention_law import FOLDER
    from nerg_mi.transport.geometry import SceneGeometry

    import drjit as dr
    import mitsuba as mi

    shelf = attention.shelf
    store = {
        "type": "ply",
        "filename": str(FOLDER / "twin.ply"),
        "face_normals": True,
        "bsdf": {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "face_color"}},
    }
    scene = mi.load_dict({"type": "scene", "store": store, "box": shelf.box(at)})
    low, high = shelf.low[shelf.along], shelf.high[shelf.along]
    u, z = np.arange(low + spacing / 2, high, spacing), np.arange(spacing / 2, shelf.high[2] + 0.2, spacing)[::-1]
    grid = np.empty((len(z), len(u), 3), np.float32)
    grid[..., shelf.along], grid[..., 2] = u, z[:, None]
    grid[..., shelf.axis] = shelf.front + shelf.sign * 0.3
    toward = np.zeros(3)
    toward[shelf.axis] = -shelf.sign
    ray = mi.Ray3f(mi.Point3f(np.ascontiguousarray(grid.reshape(-1, 3).T)), mi.Vector3f(*toward.tolist()))
    si = scene.ray_intersect(ray)
    albedo = si.bsdf(ray).eval_diffuse_reflectance(si)
    points = Patches(dr.detach(si.p), mi.Vector3f(si.n), mi.Float(1))
    dr.eval(points.p, points.n)
    total, place, count = (
        dr.zeros(mi.Float, len(grid.reshape(-1, 3))),
        SceneGeometry(None, scene),
        dr.width(attention.observers),
    )
    for a in range(0, count, 16):
        some = dr.arange(mi.UInt32, min(16, count - a)) + dr.opaque(mi.UInt32, a)
        people = dr.gather(mi.Point3f, attention.observers, some)
        each = attention_per_patch(place, attention.density, people, points, attention.falloff)
        for k in range(dr.width(people)):
            total += dr.gather(mi.Float, each, dr.arange(mi.UInt32, dr.width(total)) + k * dr.width(total))
        dr.eval(total)
    shape = grid.shape[:2]
    color = np.array(albedo).T.reshape(*shape, 3)
    return color, np.array(total).reshape(shape) / count, (low, high, 0.0, shelf.high[2] + 0.2)


def figure(attention: Attention, sweep, paths, checks, settings: Settings):
    """The shelf before and after, the sweep with the ascents, and the derivatives, above one common axis."""
    from nerg_mi.figures.overlay import Heat, overlay, robust_max

    from matplotlib.figure import Figure

    at, values = sweep
    # Of the ascents the one that gained most.
    best = max(paths, key=lambda p: attention.value(p[-1]) - attention.value(p[0]))
    sheet = Figure(figsize=(7.2, 9.6), layout="constrained")
    axes = sheet.subplots(4, 1, sharex=True, height_ratios=(1.9, 1.9, 1.4, 1.2))
    shown = [elevation(attention, x, settings.pixels) for x in (best[0], best[-1])]
    heat = Heat(robust_max(shown[1][1], shown[1][1] >= 0))
    for ax, (color, gaze, extent), x, what in zip(axes, shown, (best[0], best[-1]), ("start", "end")):
        ax.imshow(overlay(color, gaze, heat, gaze >= 0), extent=extent, aspect="equal", interpolation="nearest")
        ax.set_ylabel("height [m]")
        ax.set_title(f"The box at the {what} of an ascent: {100 * attention.value(x):.2f} % of all looks", fontsize=9)
    axes[2].plot(at, 100 * values, color="0.6", lw=2, label="sweep")
    for n, path in enumerate(paths):
        height = 100 * np.interp(path, at, values)
        axes[2].plot(path, height, ".-", ms=3, lw=0.6, color=f"C{n}")
        axes[2].plot(path[0], height[0], "o", mfc="none", color=f"C{n}")
        axes[2].plot(path[-1], height[-1], "*", ms=11, color=f"C{n}")
    axes[2].set_ylabel("attention [% of looks]")
    axes[2].legend(["sweep", "ascent", "its start", "its end"], fontsize=7)
    axes[3].axhline(0, color="0.8", lw=0.8)
    axes[3].plot(
        at[1:-1], 100 * (values[2:] - values[:-2]) / (at[2:] - at[:-2]), color="0.6", lw=2, label="of the sweep"
    )
    axes[3].plot(checks[:, 0], 100 * checks[:, 1], "x", color="C3", label="automatic")
    axes[3].set_ylabel("derivative [% / m]")
    axes[3].set_xlabel(f"position along the shelf, {'xy'[attention.shelf.along]} [m]")
    axes[3].legend(fontsize=7)
    if attention.shelf.sign * (1 if attention.shelf.along == 1 else -1) < 0:
        axes[3].invert_xaxis()  # as one sees it who stands in front
    return sheet


def main(argv=None) -> dict:
    import mitsuba as mi

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shelf", default="gondola_1_west", help="how the names of its regions begin (regions.json)")
    parser.add_argument("--seed", type=int, default=0, help="of the stream of shoppers")
    parser.add_argument("--out", type=Path, default=Path("place-product.png"))
    parser.add_argument("--quick", action="store_true", help="few observers and steps: a try in seconds")
    args = parser.parse_args(argv)
    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb")
    settings = QUICK if args.quick else Settings()
    shelf = Shelf(args.shelf)
    attention = Attention(shelf, stream(settings.observers, args.seed), settings)

    at = np.linspace(*shelf.range, 1 + round((shelf.range[1] - shelf.range[0]) / settings.spacing))
    values = np.array([attention.value(x) for x in at])
    top = at[values.argmax()]
    if values.max() == 0:
        raise SystemExit(
            f"not one of {settings.observers} observers sees a place on {args.shelf}; take another --seed or shelf"
        )
    print(
        f"sweep of {len(at)} positions: {100 * values.min():.3f} to {100 * values.max():.3f} % of looks, "
        f"most at {top:.2f} m"
    )

    starts = shelf.range[0] + (np.arange(settings.starts) + 0.5) / settings.starts * (shelf.range[1] - shelf.range[0])
    paths, rows = [], []
    print("start [m]  end [m]  attention [%]      sweep's optimum uphill [m]  apart [cm]  of its value")
    for start in starts:
        path = attention.climb(float(start), settings.steps)
        goal = uphill(values, int(np.abs(at - start).argmin()))
        a, b = attention.value(path[0]), attention.value(path[-1])
        paths.append(path)
        rows.append((path[0], path[-1], a, b, at[goal], b / values[goal]))
        print(
            f"{path[0]:9.3f}  {path[-1]:7.3f}  {100 * a:.3f} -> {100 * b:.3f}  {at[goal]:27.2f}  "
            f"{100 * abs(path[-1] - at[goal]):10.1f}  {b / values[goal]:12.4f}"
        )

    where = np.linspace(*shelf.range, settings.checks + 2)[1:-1]
    checks = np.array([[x, *attention.derivatives(float(x))] for x in where])
    off = [_rms(checks[:, k] - checks[:, k + 1]) / _rms(checks[:, k + 1]) for k in (1, 3)]
    print(
        f"derivatives at {len(where)} positions, automatic against central differences (rms of the difference / rms):"
    )
    print(f"  all pairs of observer and patch               {100 * off[0]:6.2f} %")
    print(f"  without pairs that an edge passes ({100 * checks[:, 5].mean():.2f} %)   {100 * off[1]:6.2f} %")

    from nerg_mi.figures.style import save

    save(figure(attention, (at, values), paths, checks, settings), args.out)
    print(f"wrote {args.out}")
    return {"sweep": (at, values), "rows": rows, "checks": checks, "off": off}


def _rms(x) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


if __name__ == "__main__":
    main()
