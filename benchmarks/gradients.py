"""Derivatives of images compared with central differences, for all quantities and parameters.

    python benchmarks/gradients.py [--depth median] [--case NAME]

Each case moves one parameter, or all weights of one kind together, along a fixed line. Forward mode gives the
derivatives of all pixels, as computed by ``mi.render``. Reverse mode gives the derivative of one weighted sum of the
pixels of one quantity. Both are compared with central differences of images at two distances, extrapolated (Richardson
extrapolation). Reverse mode is also compared with the weighted sum of the forward derivatives, the dot-product test,
which holds up to rounding. The benchmark prints Markdown and does not pass or fail.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_base import GazeEnsemble
from nerg_mi.fields.gaze_product import GazeConfig, ProductHead
from nerg_mi.fields.mlp import namespace
from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork
from nerg_mi.formats.fields import save_gaze, save_radiance
from nerg_mi.maths.geometry import Box
from nerg_mi.transport.mitsuba_mesh import pack_positions, positions_key, unpack_positions
from timing import save_result

import drjit as dr
import numpy as np

AOVS = "depth,opacity,position,gaze,emit,capture,visibility,observer_depth"
SIZE = 12
GRID = HashGridConfig(levels=2, log2_rows=10, base=3, finest=5)
BOX, AROUND = Box((-1, -1, -1), (1, 1, 1)), Box((-3.7, -3.7, -3.7), (3.7, 3.7, 3.7))


@dataclass
class Case:
    """A parameter that moves. ``scene``: a key of ``SCENES``; ``keys``: of ``mi.traverse``, moved together; ``line``:
    value of a parameter at x from its ``(mi, key, base, x)``; ``h``: step of the differences."""

    name: str
    scene: str
    keys: list[str]
    line: Callable
    h: float


def write_fields(mi, folder: Path) -> None:
    """A radiance field over the cube of side 2, a gaze field over a larger one, and an ensemble of it and another one.

    Features are positive, and the weights of each neuron have one sign: some ReLUs pass and some block, and none
    switches while a parameter moves, so that differences are those of a smooth function.
    """
    ns = namespace(mi.variant())
    rng = np.random.default_rng(0)
    config = RadianceConfig(GRID, width=16, geometry=7, sh_degree=2, density_scale=0.4)
    radiance = RadianceNetwork.random(config, BOX, ns, 0, march_step=0.1)
    gaze, other = (
        ProductHead.random(GazeConfig(GRID, width=16, geometry=7, sh_degree=2), AROUND, ns, seed) for seed in (1, 2)
    )
    for one in (radiance, gaze, other):
        values = {"grid.table": ns.Float(rng.uniform(0.2, 1.8, len(one.grid.table)).astype(np.float32))}
        for name, w in one.parameters().items():
            if name == "grid.table":
                continue
            layer = rng.uniform(0.3, 1.7, w.shape) / w.shape[1]
            last = name in ("density_net.1", "position_net.1", "color_net.2", "emit_head.0", "capture_head.0")
            if not last:
                layer[::3] *= -1
            if name in ("color_net.0", "direction_net.0"):
                # Harmonics of the direction have both signs: the features behind them dominate.
                layer[:, 1:4] *= rng.choice([-1, 1], (len(w), 3)) * (5 if name == "direction_net.0" else 1)
                layer[:, 4:] *= 2
            elif name in ("color_net.2", "emit_head.0", "capture_head.0"):
                layer = (0.1 if name == "color_net.2" else 0.4) * rng.normal(size=w.shape)
                layer -= layer.mean(axis=1, keepdims=True)
            values[name] = ns.TensorXf((1.5 * layer).astype(np.float32))
        one.set_parameters(values)
    save_radiance(radiance, folder / "field.safetensors", {})
    save_gaze(gaze, folder / "gaze.safetensors", {})
    save_gaze(GazeEnsemble([gaze, other]), folder / "ensemble.safetensors", {})


# ----------------------------------------------------------------------------
# Scenes
# ----------------------------------------------------------------------------


def look_at(mi, origin, target=(0, 0, 0)):
    return mi.ScalarTransform4f().look_at(list(origin), list(target), [0, 1, 0])


def camera(mi, origin=(0.3, 0.2, -3), fov=20, size=SIZE):
    """One ray through the centre of each pixel, for any seed: mi.render uses another seed for derivatives."""
    film = {"type": "hdrfilm", "width": size, "height": size, "component_format": "float32", "rfilter": {"type": "box"}}
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": look_at(mi, origin),
        "film": film,
        "sampler": {"type": "stratified", "jitter": False, "sample_count": 1},
    }


def integrator(mi, folder, observer=(-2, 0.5, 2), **overrides):
    eye = {} if observer is None else {"observer": {"type": "perspective", "to_world": look_at(mi, observer)}}
    return {
        "type": "nerg",
        "gaze": {"type": "gazefield", "filename": str(folder / "gaze.safetensors")},
        "aovs": AOVS,
        "step": 0.1,
        "stop": 1e-12,
        "color_cutoff": 0.0,
        "surface_opacity": 0.0,
        "background": 0.3,
        "falloff": 4.0,
        "tolerance": 0.05,
        **eye,
        **overrides,
    }


def field_scene(mi, folder, **overrides):
    """With the AOVs that require a field and an ensemble of gaze fields."""
    field = {"type": "nerf", "filename": str(folder / "field.safetensors")}
    gaze = {"type": "gazefield", "filename": str(folder / "ensemble.safetensors")}
    metadata = {"aovs": f"{AOVS},features,features_at,gaze_std", "field": field, "gaze": gaze, **overrides}
    return {"integrator": integrator(mi, folder, **metadata), "sensor": camera(mi)}


def constant_scene(mi, folder, **overrides):
    place = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    color = {"type": "constvolume", "value": {"type": "rgb", "value": [0.8, 0.5, 0.2]}}
    density = {"type": "constvolume", "value": 1.2, "to_world": place}
    return {"integrator": integrator(mi, folder, density=density, color=color, **overrides), "sensor": camera(mi)}


def grid_scene(mi, folder, **overrides):
    rng = np.random.default_rng(2)
    place = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    volume = lambda data: {
        "type": "gridvolume",
        "grid": mi.VolumeGrid(data.astype(np.float32)),
        "to_world": place,
        "raw": True,
    }
    density, color = volume(0.1 + rng.exponential(1.2, (4, 5, 6))), volume(rng.uniform(0.1, 0.9, (4, 5, 6, 3)))
    return {"integrator": integrator(mi, folder, density=density, color=color, **overrides), "sensor": camera(mi)}


def shapes_scene(mi, folder, **overrides):
    """A tilted slab that all camera rays hit, and a larger one between it and the observer: no silhouette is
    visible."""
    slab = lambda z, size, tilt: (
        mi.ScalarTransform4f().translate([0, 0, z]).rotate([0.6, 1, 0], tilt).scale([size, size, 0.05])
    )
    paint = lambda *rgb: {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(rgb)}}
    return {
        "integrator": integrator(mi, folder, observer=(-0.9, 0.4, 2.8), **overrides),
        "sensor": camera(mi),
        "slab": {"type": "cube", "to_world": slab(-0.3, 0.8, 20), "bsdf": paint(0.8, 0.5, 0.2)},
        "lid": {"type": "cube", "to_world": slab(1.5, 2.5, -15)},
    }


def ball_scene(mi, folder, **overrides):
    paint = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.5, 0.2]}}
    return {
        "integrator": integrator(mi, folder, observer=(-2, 0.5, -2.5), **overrides),
        "sensor": camera(mi, fov=12),
        "ball": {"type": "sphere", "radius": 0.8, "bsdf": paint},
    }


def both_scene(mi, folder, **overrides):
    """A slab behind a haze."""
    place = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    color = {"type": "constvolume", "value": {"type": "rgb", "value": [0.2, 0.3, 0.9]}}
    return shapes_scene(
        mi, folder, density={"type": "constvolume", "value": 0.25, "to_world": place}, color=color, **overrides
    )


def alone(make):
    """The camera is the observer."""
    return lambda mi, folder, **more: make(mi, folder, **more, observer=None)


SCENES = {
    "field": field_scene,
    "constant": constant_scene,
    "grid": grid_scene,
    "shapes": shapes_scene,
    "ball": ball_scene,
    "both": both_scene,
    "field, own camera": alone(field_scene),
    "field, transmittance": lambda mi, folder, **more: field_scene(mi, folder, visibility="transmittance", **more),
}


# ----------------------------------------------------------------------------
# Moving parameters
# ----------------------------------------------------------------------------


def along(seed: int):
    """Weights and voxels, all along one random line."""

    def line(mi, key, base, x):
        rng = np.random.default_rng([seed, *key.encode()])
        direction = rng.normal(size=base.shape if hasattr(base, "shape") else dr.width(base)).astype(np.float32)
        return base + type(base)(direction) * x

    return line


def number(scale=1.0):
    return lambda mi, key, base, x: base + scale * x


def color(mi, key, base, x):
    return base + mi.Color3f(1, -0.5, 0.7) * x


def walk(mi, key, base, x):
    """Translation of a pose."""
    return mi.Transform4f().translate(mi.Vector3f(0.3 * x, x, -0.5 * x)) @ mi.Transform4f(base)


def turn(mi, key, base, x):
    """Rotation of a pose about an axis through the origin."""
    return mi.Transform4f().rotate(mi.Vector3f(0.2, 1, 0.3), 20 * x) @ mi.Transform4f(base)


def vertices(mi, key, base, x):
    p = unpack_positions(base)
    return pack_positions(p + mi.Vector3f(0.3 * x, -0.2 * x, x) * (1 + 0.2 * p.x))


def nets(prefix, *names):
    return [f"integrator.{prefix}.{n}" for n in names]


def cases() -> list[Case]:
    density, paint = (
        nets("field", "density_net.0", "density_net.1"),
        nets("field", "color_net.0", "color_net.1", "color_net.2"),
    )
    heads = "position_net.0", "position_net.1", "direction_net.0", "direction_net.1", "emit_head.0", "capture_head.0"
    both = lambda *names: [key for member in (0, 1) for key in nets(f"gaze.{member}", *names)]
    return [
        Case("field: hash table", "field", nets("field", "grid.table"), along(1), 2e-2),
        Case("field: density network", "field", density, along(1), 2e-3),
        Case("field: colour network", "field", paint, along(1), 2e-3),
        Case("gaze: hash table", "constant", nets("gaze", "grid.table"), along(1), 2e-2),
        Case("gaze: networks", "constant", nets("gaze", *heads), along(1), 1e-3),
        Case("ensemble of gaze: hash tables", "field", both("grid.table"), along(1), 2e-2),
        Case("ensemble of gaze: networks", "field", both(*heads), along(1), 1e-3),
        Case("constvolume: density", "constant", ["integrator.density.value.value"], number(), 2e-2),
        Case("constvolume: colour", "constant", ["integrator.color.value.value"], color, 2e-2),
        Case("gridvolume: density", "grid", ["integrator.density.data"], along(1), 4e-3),
        Case("gridvolume: colour", "grid", ["integrator.color.data"], along(1), 2e-2),
        Case("falloff", "field", ["integrator.falloff"], number(), 4e-2),
        Case("observer: position", "field", ["integrator.observer.to_world"], walk, 4e-3),
        Case("... by transmittance", "field, transmittance", ["integrator.observer.to_world"], walk, 4e-3),
        Case("... before shapes", "shapes", ["integrator.observer.to_world"], walk, 4e-3),
        Case("camera: moved", "field", ["sensor.to_world"], walk, 4e-3),
        Case("camera: turned", "field", ["sensor.to_world"], turn, 4e-3),
        Case("camera that is the observer", "field, own camera", ["sensor.to_world"], walk, 4e-3),
        Case("camera before shapes", "shapes", ["sensor.to_world"], walk, 4e-3),
        Case("mesh: vertices", "shapes", [f"slab.{positions_key()}"], vertices, 4e-3),
        Case("mesh: vertices of what hides it", "shapes", [f"lid.{positions_key()}"], vertices, 4e-3),
        Case("mesh in a haze: vertices", "both", [f"slab.{positions_key()}"], vertices, 4e-3),
        Case("sphere: to_world", "ball", ["ball.to_world"], walk, 4e-3),
        Case("shape: colour", "shapes", ["slab.bsdf.reflectance.value"], color, 2e-2),
    ]


# Derivatives that miss a discontinuity: (1), (2), ... refer to the list above the table in
# docs/explanation/numerics.md ("Excluded derivatives").
EXCLUDED = {
    "shape: its silhouette": dict.fromkeys(
        ("colour", "depth", "opacity", "position", "gaze", "emit", "capture", "visibility", "observer depth"),
        "excluded (1)",
    ),
    "silhouette of what hides": dict.fromkeys(("gaze", "emit", "visibility", "observer depth"), "excluded (2)"),
    "anything, falloff 0": dict.fromkeys(("gaze", "visibility"), "excluded (3)"),
    "field and observer, map": dict.fromkeys(("visibility", "observer depth"), "excluded (4)"),
    "shape lit by path": {"colour": "excluded (5)"},
}


QUANTITIES = {
    "colour": "RGB",
    "depth": ["depth.T"],
    "opacity": ["opacity.Y"],
    "position": ["position.X", "position.Y", "position.Z"],
    "gaze": ["gaze.Y"],
    "emit": ["emit.Y"],
    "capture": ["capture.Y"],
    "visibility": ["visibility.Y"],
    "observer depth": ["observer_depth.T"],
    "features": ["features.0", "features.1"],
    "features at": ["features_at.0", "features_at.1"],
    "spread of gaze": ["gaze_std.Y"],
}


@dataclass
class Entry:
    """Relative errors of one quantity's derivative with respect to one parameter: ``forward`` (over pixels, L2) and
    ``reverse`` against central differences, ``dot`` of one against the other. ``share``: fraction of the image without
    a kink within the step of the differences, to which the errors refer; ``doubt``: disagreement of the differences at
    both distances."""

    forward: float
    reverse: float
    dot: float
    share: float
    doubt: float


def measure(mi, scene, case, quantities=QUANTITIES) -> dict:
    """``Entry`` of each quantity of the scene, or None if it does not depend on the parameter."""
    import drjit as dr

    params = mi.traverse(scene)
    base = {key: type(params[key])(params[key]) for key in case.keys}
    names = scene.integrator().aov_names()

    def image(x):
        for key, value in base.items():
            params[key] = case.line(mi, key, value, x)
        params.update()
        return mi.render(scene, params=params, spp=1, seed=0)

    def picture(x):
        return np.array(image(mi.Float(x)), float)

    x = mi.Float(0)
    dr.enable_grad(x)
    out = image(x)
    dr.forward(x)
    tangent = np.array(dr.grad(out), float)
    middle, h = picture(0), case.h
    ends = {s: picture(s * h) for s in (1, -1, 0.5, -0.5)}
    wide, near = (ends[1] - ends[-1]) / (2 * h), (ends[0.5] - ends[-0.5]) / h
    difference = (4 * near - wide) / 3
    # A kink within the step shows in the differences: their two sides disagree by more than a smooth function's.
    bend, bend_near = np.abs(ends[1] + ends[-1] - 2 * middle) / h, np.abs(ends[0.5] + ends[-0.5] - 2 * middle) * 2 / h
    result = {}
    for name, channels in quantities.items():
        if channels != "RGB" and not set(channels) <= set(names):
            continue
        where = [0, 1, 2] if channels == "RGB" else [3 + names.index(c) for c in channels]
        fd, ad, span = difference[..., where], tangent[..., where], np.abs(middle[..., where]).max()
        scale = np.sqrt(np.mean(fd**2))
        if not np.abs(ad).max() > 1e-5 * span and not np.abs(fd).max() > 1e-4 * span:
            result[name] = None
            continue
        smooth = np.abs(wide - near)[..., where] <= 0.02 * scale + 0.02 * np.abs(fd)
        smooth &= np.maximum(bend, bend_near)[..., where] <= 0.2 * scale + 0.2 * np.abs(fd)
        doubt = norm((wide - near)[..., where][smooth]) / norm(fd[smooth])
        weights = np.random.default_rng(0).uniform(0.2, 1, fd.shape) * smooth
        mask = np.zeros(middle.shape, np.float32)
        mask[..., where] = weights
        w = mask[..., where].astype(float)
        x = mi.Float(0)
        dr.enable_grad(x)
        dr.backward(dr.sum(image(x) * mi.TensorXf(mask), axis=None))
        reverse = float(np.array(dr.grad(x)).item())
        # Relative to the sum of magnitudes: terms of both signs can cancel.
        size = np.abs(w * fd).sum()
        result[name] = Entry(
            norm((ad - fd)[smooth]) / norm(fd[smooth]),
            abs(reverse - (w * fd).sum()) / size,
            abs(reverse - (w * ad).sum()) / size,
            float(smooth.mean()),
            doubt,
        )
    image(mi.Float(0))
    return result


def norm(x) -> float:
    return float(np.sqrt(np.sum(np.square(x)))) + 1e-30


def errors(mi, only: str, depth: str) -> tuple[list[str], list[list[str]]]:
    """The columns and rows of all cases, with surfaces at ``depth``."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        write_fields(mi, Path(folder))
        for case in cases():
            if only not in case.name:
                continue
            scene = mi.load_dict({"type": "scene", **SCENES[case.scene](mi, Path(folder), depth=depth)})
            rows.append([case.name, *summary(measure(mi, scene, case))])
            print(rows[-1], file=sys.stderr, flush=True)
    for name, reason in EXCLUDED.items():
        if only in name:
            rows.append([name, *(reason.get(q, "") for q in QUANTITIES), "", "", ""])
    head = ["with respect to", *QUANTITIES, "reverse against forward mode", "central differences", "pixels excluded"]
    return head, rows


def summary(result: dict) -> list[str]:
    text = lambda e: f"{e.forward:.0e} / {e.reverse:.0e}" if e else "none"
    cells = [text(result[quantity]) if quantity in result else "" for quantity in QUANTITIES]
    expected = [e for e in result.values() if e]
    return [
        *cells,
        f"{max(e.dot for e in expected):.0e}",
        f"{max(e.doubt for e in expected):.0e}",
        f"{1 - min(e.share for e in expected):.0%}",
    ]


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--case", default="", help="Text that the names of the measured cases contain. Default: all cases."
    )
    parser.add_argument(
        "--depth", default="median", help="Depth of surfaces: median, expected or refined. Default: %(default)s."
    )
    parser.add_argument("-m", "--mode", default="llvm_ad_rgb", help="Mitsuba variant. Default: %(default)s.")
    args = parser.parse_args(argv)

    import mitsuba as mi

    mi.set_variant(args.mode)
    # Mitsuba declares a sensor's pose as not differentiable and warns on each update.
    mi.set_log_level(mi.LogLevel.Error)
    save_result("derivatives", *errors(mi, args.case, args.depth))


if __name__ == "__main__":
    main()
