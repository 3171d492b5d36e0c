"""Find the position along a shelf where a product is looked at most, by gradient ascent on its attention.

    python examples/place_product.py [--shelf gondola_1_west] [--seed 0] [--out place-product.png] [--quick]

A box is placed at the front edge of a shelf of the demo store. Simulated shoppers pass by, and the gaze field predicts
where they look. The expected probability of looking at the box is an integral over the points of its surface
(``nerg_mi.environment.surface_attention``), so automatic differentiation gives its derivative with respect to the
position of the box, through distance, direction, gaze networks and fall-off. Gradient ascent runs from several starts;
a sweep along the whole shelf verifies the optima, and central differences verify the derivatives. The moving edges of
other occluders are not differentiated; the resulting error is measured.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)

import numpy as np

SIZE = (0.24, 0.12, 0.25)  # along, into and above the shelf, metres
JUTS_OUT = 0.06  # metres by which the box protrudes over the edge of the shelf
STEP = 2.5e-3  # metres of a central difference
SWITCH = 0.25  # relative change of a visible solid angle over two such steps that only an edge can cause


@dataclass(frozen=True)
class Settings:
    """Settings of the example.

    ``observers`` is their number, ``divisions`` that of each triangle of the box, ``spacing`` that of the sweep in
    metres; ``starts`` and ``steps`` define the ascents, ``checks`` the number of compared derivatives, and ``pixels``
    the size of a pixel of the picture in metres.
    """

    observers: int = 256
    divisions: int = 4
    spacing: float = 0.02
    starts: int = 5
    steps: int = 50
    checks: int = 24
    pixels: float = 0.02


QUICK = Settings(observers=48, divisions=2, spacing=0.1, starts=2, steps=20, checks=4, pixels=0.1)


def stream(count: int, seed: int) -> np.ndarray:
    """Return head positions (count, 3) in metres of shoppers at random times of their visits."""
    from nerg_mi.scenes.store import attention_law, layout, shoppers

    store_layout = layout.build_store(0)
    store, rng = shoppers.WaypointGraph(store_layout), np.random.default_rng([seed, 0xB0C5])
    weights = 0.5 + attention_law.AttentionLaw().attractiveness
    visits = [
        shoppers.simulate_visit(store, rng, int(rng.integers(8, 21)), weights).head for _ in range(max(2, count // 16))
    ]
    heads = np.concatenate(visits)
    return heads[rng.choice(len(heads), count, replace=False)]


class Shelf:
    """A shelf board and a box on it. Positions along the shelf are world coordinates in metres."""

    def __init__(self, name: str):
        from nerg_mi.scenes.store.attention_law import read_regions

        all_regions = read_regions()
        regions = [r for r in all_regions if r["name"].startswith(name)]
        if not regions:
            names = ", ".join(r["name"] for r in all_regions)
            raise SystemExit(f'there is no shelf "{name}"; the regions of the store are {names}')
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
        """Return the box as a Mitsuba shape."""
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
    """Expected attention of observers on a box on a shelf, and its derivative."""

    def __init__(self, shelf: Shelf, heads: np.ndarray, settings: Settings, falloff: float = 0.05):
        from nerg_mi.environment.surface_attention import make_patches
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

    def _evaluate_patches(self, at, density):
        from nerg_mi.environment.surface_attention import attention_per_patch

        import mitsuba as mi

        offset = [mi.Float(0)] * 3
        offset[self.shelf.along] = at
        return attention_per_patch(
            self.place, density, self.observers, self.surface.translate(mi.Vector3f(offset)), self.falloff
        )

    def expected(self, at):
        """Return the probability (Float) of looking at the box at position ``at`` (Float), averaged over the
        observers."""
        import drjit as dr

        return dr.sum(self._evaluate_patches(at, self.density)) / dr.width(self.observers)

    def value(self, at: float) -> float:
        import drjit as dr
        import mitsuba as mi

        return float(self.expected(dr.opaque(mi.Float, at))[0])

    def climb(self, start: float, steps: int, rate: float = 0.04) -> np.ndarray:
        """Run gradient ascent from ``start`` with Adam, with a rate that falls to 0, within the shelf; returns
        positions (steps + 1,).
        """
        import drjit as dr
        import mitsuba as mi

        optimizer = mi.ad.Adam(lr=rate, params={"at": mi.Float(start)}, beta_1=0.8, beta_2=0.95)
        path = [start]
        for step in range(steps):
            optimizer.set_learning_rate(rate * 0.5 * (1 + np.cos(np.pi * step / steps)))
            # Adam is invariant to the scale of the objective; 1e3 makes its epsilon negligible.
            dr.backward(-1e3 * self.expected(optimizer["at"]))
            optimizer.step()
            optimizer["at"] = dr.clip(dr.detach(optimizer["at"]), *self.shelf.range)
            path.append(float(optimizer["at"][0]))
        return np.array(path)

    def derivatives(self, at: float) -> np.ndarray:
        """Compute derivatives at ``at``, (5,): automatic and by central differences, of the whole integral and without
        the pairs of observer and patch between which an edge passes, and the fraction of such pairs.
        """
        import drjit as dr
        import mitsuba as mi

        def solid_angle(p_od, p_o, r_o, active):
            return mi.Float(1)

        ends = [dr.opaque(mi.Float, at + s * STEP) for s in (1, -1)]
        solid_angles = [self._evaluate_patches(x, solid_angle) for x in ends]
        is_smooth = dr.abs(solid_angles[0] - solid_angles[1]) <= SWITCH * dr.maximum(solid_angles[0], solid_angles[1])
        values = [self._evaluate_patches(x, self.density) for x in ends]
        num_observers, out = dr.width(self.observers), []
        for mask in (mi.Bool(True), is_smooth):
            x = dr.opaque(mi.Float, at)
            dr.enable_grad(x)
            dr.backward(dr.sum(dr.select(mask, self._evaluate_patches(x, self.density), 0)) / num_observers)
            difference = dr.sum(dr.select(mask, values[0] - values[1], 0)) / num_observers
            out += [float(dr.grad(x)[0]), float(difference[0]) / (2 * STEP)]
        return np.array([*out, 1 - float(dr.mean(mi.Float(is_smooth))[0])])


def uphill(values: np.ndarray, start: int, window: int = 2) -> int:
    """Return the index of the local maximum reached from ``start`` by moving to the best of ``window`` neighbours per
    side.
    """
    while True:
        low = max(start - window, 0)
        best = low + int(np.argmax(values[low : start + window + 1]))
        if best == start:
            return start
        start = best


def elevation(attention: Attention, at: float, spacing: float):
    """Render the front view of the shelf with the box at ``at``: albedo (h, w, 3), attention (h, w) in 1/m², extent in
    metres.
    """
    from nerg_mi.environment.surface_attention import Patches, attention_per_patch
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
    total, scene_geometry, count = (
        dr.zeros(mi.Float, len(grid.reshape(-1, 3))),
        SceneGeometry(None, scene),
        dr.width(attention.observers),
    )
    for a in range(0, count, 16):
        indices = dr.arange(mi.UInt32, min(16, count - a)) + dr.opaque(mi.UInt32, a)
        observers = dr.gather(mi.Point3f, attention.observers, indices)
        each = attention_per_patch(scene_geometry, attention.density, observers, points, attention.falloff)
        for k in range(dr.width(observers)):
            total += dr.gather(mi.Float, each, dr.arange(mi.UInt32, dr.width(total)) + k * dr.width(total))
        dr.eval(total)
    shape = grid.shape[:2]
    color = np.array(albedo).T.reshape(*shape, 3)
    return color, np.array(total).reshape(shape) / count, (low, high, 0.0, shelf.high[2] + 0.2)


def figure(attention: Attention, sweep, paths, checks, settings: Settings):
    """Draw the shelf before and after, the sweep with the ascents, and the derivatives, with a common axis."""
    from nerg_mi.figures.overlay import Heat, overlay, robust_max

    from matplotlib.figure import Figure

    at, values = sweep
    # Show the ascent with the largest gain.
    best = max(paths, key=lambda p: attention.value(p[-1]) - attention.value(p[0]))
    sheet = Figure(figsize=(7.2, 9.6), layout="constrained")
    axes = sheet.subplots(4, 1, sharex=True, height_ratios=(1.9, 1.9, 1.4, 1.2))
    shown = [elevation(attention, x, settings.pixels) for x in (best[0], best[-1])]
    heat = Heat(robust_max(shown[1][1], shown[1][1] >= 0))
    for ax, (color, gaze, extent), x, what in zip(axes, shown, (best[0], best[-1]), ("start", "end")):
        ax.imshow(overlay(color, gaze, heat, gaze >= 0), extent=extent, aspect="equal", interpolation="nearest")
        ax.set_ylabel("height [m]")
        ax.set_title(f"The box at the {what} of an ascent: {100 * attention.value(x):.2f} % of gaze", fontsize=9)
    axes[2].plot(at, 100 * values, color="0.6", lw=2, label="sweep")
    for n, path in enumerate(paths):
        height = 100 * np.interp(path, at, values)
        axes[2].plot(path, height, ".-", ms=3, lw=0.6, color=f"C{n}")
        axes[2].plot(path[0], height[0], "o", mfc="none", color=f"C{n}")
        axes[2].plot(path[-1], height[-1], "*", ms=11, color=f"C{n}")
    axes[2].set_ylabel("attention [% of gaze]")
    axes[2].legend(["sweep", "ascent", "start", "end"], fontsize=7)
    axes[3].axhline(0, color="0.8", lw=0.8)
    axes[3].plot(
        at[1:-1], 100 * (values[2:] - values[:-2]) / (at[2:] - at[:-2]), color="0.6", lw=2, label="of the sweep"
    )
    axes[3].plot(checks[:, 0], 100 * checks[:, 1], "x", color="C3", label="automatic")
    axes[3].set_ylabel("derivative [% / m]")
    axes[3].set_xlabel(f"position along the shelf, {'xy'[attention.shelf.along]} [m]")
    axes[3].legend(fontsize=7)
    if attention.shelf.sign * (1 if attention.shelf.along == 1 else -1) < 0:
        axes[3].invert_xaxis()  # as seen from the front
    return sheet


def main(argv=None) -> dict:
    import mitsuba as mi

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--shelf", default="gondola_1_west", help="prefix of its region names in regions.json (default: gondola_1_west)"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the shoppers (default: 0)")
    parser.add_argument("--out", type=Path, default=Path("place-product.png"), help="output picture")
    parser.add_argument("--quick", action="store_true", help="use few observers and steps, to finish in seconds")
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
            f"none of {settings.observers} observers sees a position on {args.shelf}; use another --seed or --shelf"
        )
    print(
        f"sweep of {len(at)} positions: {100 * values.min():.3f} to {100 * values.max():.3f} % of gaze, "
        f"maximum at {top:.2f} m"
    )

    starts = shelf.range[0] + (np.arange(settings.starts) + 0.5) / settings.starts * (shelf.range[1] - shelf.range[0])
    paths, rows = [], []
    print("start [m]  end [m]  attention [%]      optimum of the sweep [m]  distance [cm]  relative value")
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
    print(f"derivatives at {len(where)} positions, automatic and central differences (rms of the difference / rms):")
    print(f"  all pairs of observer and patch               {100 * off[0]:6.2f} %")
    print(f"  without pairs crossed by an edge ({100 * checks[:, 5].mean():.2f} %)   {100 * off[1]:6.2f} %")

    from nerg_mi.figures.style import save

    save(figure(attention, (at, values), paths, checks, settings), args.out)
    print(f"wrote {args.out}")
    return {"sweep": (at, values), "rows": rows, "checks": checks, "off": off}


def _rms(x) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


if __name__ == "__main__":
    main()
