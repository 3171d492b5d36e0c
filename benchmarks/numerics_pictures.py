"""Numerical errors of pictures: observers in odd places, shadow acne, silhouettes, samples, films."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from nerg_mi.field.backend import namespace
from nerg_mi.field.encoding.harmonics import encode_direction
from nerg_mi.field.encoding.hashgrid import HashGridConfig
from nerg_mi.field.gaze.product import GazeConfig, GazeField
from nerg_mi.formats.fields import save_gaze
from nerg_mi.maths.box import Box
from nerg_mi.maths.color import composite_to_linear
from nerg_mi.transport.observer.viewpoint import distance_and_direction
from nerg_mi.transport.observer.visibility import visibility
from numerics import HEAD, Row
from numerics_media import all_finite, gradient, share, values, worst

import drjit as dr
import numpy as np

AOVS = "depth,opacity,position,gaze,visibility,observer_depth"


def tables(mi):
    yield "Observers", HEAD, [row.cells() for case in (observers, falloffs, acne, silhouettes) for row in case(mi)]
    yield "Films and colours", HEAD, [row.cells() for case in (films, colours, harmonics) for row in case(mi)]


def look_at(mi, origin, target, up=(0, 1, 0)):
    return mi.ScalarTransform4f().look_at([float(v) for v in origin], [float(v) for v in target], list(up))


def camera(mi, origin, target, size=12, fov=35, film=(), **more):
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": look_at(mi, origin, target),
        "near_clip": 1e-3,
        "sampler": {"type": "independent", "sample_count": 1},
        "film": {
            "type": "hdrfilm",
            "width": size,
            "height": size,
            "component_format": "float32",
            "rfilter": {"type": "box"},
            **dict(film),
        },
        **more,
    }


def channels(mi, integrator, sensor, spp=1):
    """The picture's AOVs by name."""
    scene = mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor})
    image = values(mi.render(scene, spp=spp))
    names = scene.integrator().aov_names()
    return dict(zip(names, np.moveaxis(image[..., image.shape[-1] - len(names) :], -1, 0))) | {"rgb": image[..., :3]}


def cube(mi, sigma, low=(-1, -1, -1), size=(2, 2, 2)):
    to_world = mi.ScalarTransform4f().translate(list(low)).scale(list(size))
    return {"type": "constvolume", "value": float(sigma), "to_world": to_world}


def eye(mi, at, **more):
    return {"type": "perspective", "to_world": look_at(mi, at, np.add(at, (0.1, 0.2, 0.3))), **more}


# ----------------------------------------------------------------------------
# Observers
# ----------------------------------------------------------------------------


def any_gaze(mi):
    """A small untrained gaze field over the cube; what it says does not matter here, that it is finite does."""
    config = GazeConfig(HashGridConfig(levels=2, log2_rows=10, base=4, finest=16), width=16, geometry=7, sh_degree=2)
    field = GazeField.random(config, Box((-1, -1, -1), (1, 1, 1)), namespace(mi.Float(0)), 0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "gaze.safetensors"
        save_gaze(field, path, {})
        return mi.load_dict({"type": "gazefield", "filename": str(path)})


def observers(mi):
    gaze = any_gaze(mi)
    base = {"type": "nerg", "density": cube(mi, 1e3), "gaze": gaze, "aovs": AOVS}
    here = (0.3, 0.2, -3.0)
    sensor = camera(mi, here, (0, 0, 0), fov=25)
    alone = channels(mi, base, sensor)
    same = channels(mi, base | {"observer": eye(mi, here)}, sensor)
    yield Row(
        "observer at the camera",
        "",
        "all channels against no observer (absolute)",
        max(worst(same[k], alone[k], False) for k in alone),
        "the picture without",
    )
    places = {
        "on the surface": (0, 0, -1),
        "inside solid matter": (0, 0, 0),
        "behind the camera": (0.6, 0.4, -6),
        "1e6 units away": (1e6, 0, -1e6),
        "at a pixel's surface point": None,
    }
    finite, share_seen = [], {}
    for name, at in places.items():
        if at is None:
            at = [alone[f"position.{c}"][6, 6] for c in "XYZ"]
        for kind in ("depth", "transmittance", "map"):
            out = channels(mi, base | {"observer": eye(mi, at), "visibility": kind, "map_height": 64}, sensor)
            finite.append(np.stack([out[k] for k in out if k != "rgb"]))
            share_seen[name, kind] = f"{out['visibility.Y'].mean():.0%}"
    yield Row(
        "observer elsewhere", ", ".join(places), "all channels, every kind of visibility", all_finite(*finite), "finite"
    )
    for name, expected in (("inside solid matter", "0 %"), ("behind the camera", "100 %"), ("on the surface", "100 %")):
        got = ", ".join(f"{k} {share_seen[name, k]}" for k in ("depth", "transmittance", "map"))
        yield Row("", name, "share of the surface that is seen", got, expected)
    for bad in (math.nan, math.inf):
        to_world = mi.ScalarTransform4f(np.array([[1, 0, 0, bad], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
        try:
            mi.load_dict(base | {"observer": {"type": "perspective", "to_world": to_world}})
            outcome = "ACCEPTED"
        except (ValueError, RuntimeError) as error:
            outcome = f'refused: "{str(error).strip().splitlines()[-1]}"'
        yield Row("observer not finite", str(bad), "", outcome, "an error that names the observer")
    v = mi.Point3f([0, 1e-18, 0], [0, 0, 1e-9], 0)
    dr.enable_grad(v)
    distance, r_o = distance_and_direction(mi.Point3f(0), v)
    dr.backward(distance + dr.sum(r_o))
    yield Row(
        "norm at zero",
        "d_o* = 0, 1e-18, 1e-9",
        "distance, direction and their derivatives",
        all_finite(values(distance), values(r_o), values(dr.grad(v))),
        "finite",
    )


def falloffs(mi):
    # d_o* and d_o: at the observer, nothing met, hidden, the surface itself, in front of what is met
    places = np.float32([(0, 0), (0, np.inf), (2, 1), (1, 1), (1, 1.5)])
    finite, wrong = [], 0.0
    for falloff in (0.0, 1e-38, 1e-8, 1.0, 4.0, 1e8, 1e30):
        f = mi.Float([falloff] * len(places))
        dr.enable_grad(f)
        y = visibility(mi.Float(places[:, 0]), mi.Float(places[:, 1]), f, 0.0)
        dr.backward(y)
        finite += [values(y), values(dr.grad(f))]
        excess = (places[:, 0] - places[:, 1]).astype(float)
        seen = 1 - (np.clip(excess / falloff, 0, 1) if falloff > 0 else (excess > 0))
        wrong = max(wrong, worst(values(y), seen, False))
    yield Row("falloff d_f", "0, 1e-38 .. 1e30", "visibility (absolute)", wrong, "closed form")
    yield Row("", "", "its derivative", all_finite(*finite), "finite")


def acne(mi):
    """A wall that the observer sees whole, along ever more grazing rays."""
    for kind in ("depth", "map", "transmittance"):
        hidden = []
        for sigma in (1e6, 1e4, 50.0):
            for angle in (0, 60, 80, 85, 88, 89):
                a = math.radians(angle)
                integrator = {
                    "type": "nerg",
                    "density": cube(mi, sigma, (-10, -10, 2), (20, 20, 0.5)),
                    "step": 0.01,
                    "visibility": kind,
                    "falloff": 0.0,
                    "radiance": False,
                    "aovs": "visibility",
                    "map_height": 256,
                    "observer": eye(mi, (2 * math.sin(a), 0, 2 - 2 * math.cos(a))),
                }
                out = channels(mi, integrator, camera(mi, (0, 0.1, 0), (0, 0, 2), fov=20))
                hidden.append(1 - out["visibility.Y"].mean())
        yield Row(
            "shadow acne" if kind == "depth" else "",
            f"0 .. 89°, σ 50 .. 1e6, falloff 0, {kind}",
            "share hidden of a wall in full view",
            max(hidden),
            "0",
        )


def silhouettes(mi):
    """A ball of soft edge before a wall: where a pixel's ray grazes it, the mean of both depths lies in mid-air."""
    n = 64
    z, y, x = np.meshgrid(*[(np.arange(n) + 0.5) / n * 2 - 1] * 3, indexing="ij")
    radius = np.sqrt((x / 0.5) ** 2 + (y / 0.5) ** 2 + ((z + 0.4) / 0.5) ** 2)
    data = np.where(z > 0.8, 1e3, 200 * np.clip((1.05 - radius) / 0.1, 0, 1)).astype(np.float32)
    volume = {
        "type": "gridvolume",
        "grid": mi.VolumeGrid(data),
        "raw": True,
        "to_world": mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2),
    }
    for depth in ("expected", "median", "refined"):
        integrator = {"type": "nerg", "density": volume, "depth": depth, "radiance": False, "aovs": "opacity,position"}
        out = channels(mi, integrator, camera(mi, (0, 0, -6), (0, 0, 0), size=96, fov=16))
        p = np.stack([out[f"position.{c}"] for c in "XYZ"], -1)
        solid = out["opacity.Y"] > 0.5
        off_ball = np.linalg.norm((p - (0, 0, -0.4)) / 0.5, axis=-1) > 1.2
        flying = solid & off_ball & (p[..., 2] < 0.7)
        yield Row(
            "flying pixels" if depth == "expected" else "",
            "a soft ball before a wall, 96 x 96",
            f"{depth}: surfaces in mid-air",
            f"{flying.sum() / solid.sum():.2%}",
            "0 %",
        )


# ----------------------------------------------------------------------------
# Films and colours
# ----------------------------------------------------------------------------


def films(mi):
    to_world = mi.ScalarTransform4f().translate([0, 0, -3]).scale([0.5, 0.5, 1])
    sensor = lambda size, film=(): {
        **camera(mi, (0, 0, -3), (0, 0, 0), size, film=film),
        "type": "orthographic",
        "to_world": to_world,
    }
    plain = {"type": "nerg", "density": cube(mi, 1.0), "depth": "expected", "aovs": "depth,opacity", "step": 0.02}

    def strip(s):
        s = dict(s)
        s.pop("fov")
        return s

    expected = {"opacity.Y": -math.expm1(-2), "depth.T": 2 - 1e-3 + 2 * float(share(2.0))}
    for name, size, spp in (
        ("1 sample a pixel", 2, 1),
        ("4096 samples a pixel", 2, 4096),
        ("1000 x 1000 pixels", 1000, 1),
    ):
        out = channels(mi, plain, strip(sensor(size)), spp)
        errors = [worst(out[k], np.full_like(out[k], e)) for k, e in expected.items()]
        yield Row(
            "films" if spp == 1 and size == 2 else "",
            name,
            "opacity; depth",
            f"{errors[0]:.1e}; {errors[1]:.1e}",
            "closed form",
        )
    view = lambda film: camera(mi, (0.3, 0.2, -3), (0, 0, 0), 12, film=film)
    soft = {"type": "nerg", "density": cube(mi, 1.0), "aovs": "depth,opacity"}
    pixel_centres = {"sampler": {"type": "stratified", "jitter": False, "sample_count": 1}}
    whole = channels(mi, soft, view(()) | pixel_centres)
    errors = []
    for x, y, w, h in ((3, 4, 5, 6), (11, 0, 1, 1), (0, 11, 12, 1)):
        crop = {"crop_offset_x": x, "crop_offset_y": y, "crop_width": w, "crop_height": h}
        part = channels(mi, soft, view(crop) | pixel_centres)
        errors += [worst(part[k], whole[k][y : y + h, x : x + w], False) for k in expected]
    yield Row("", "crops down to a pixel", "opacity, depth (absolute)", max(errors), "the crop of the whole")
    try:
        channels(mi, soft, view({"crop_width": 0, "crop_height": 0, "crop_offset_x": 0, "crop_offset_y": 0}))
        outcome = "accepted, an empty picture"
    except (ValueError, RuntimeError) as error:
        outcome = f'refused: "{str(error.__cause__ or error).strip().splitlines()[-1].strip()}"'
    yield Row("", "an empty crop", "", outcome, "an error")


def colours(mi):
    alpha = np.float32(np.concatenate([[0], np.logspace(-36, 0, 100)]))

    def composed(a):
        return mi.luminance(composite_to_linear(mi.Color3f(0.25 * a), a, "srgb"))

    y, dy = gradient(mi.Float(alpha), composed)
    linear = ((0.25 + 0.055) / 1.055) ** 2.4
    yield Row(
        "colour at any opacity",
        "α 0 .. 1",
        "radiance (absolute)",
        worst(y, linear * alpha.astype(float), False),
        "closed form",
    )
    yield Row(
        "",
        "α 1e-36 .. 1",
        "derivative with respect to α",
        worst(dy[1:], np.full(100, linear)) if all_finite(dy) == "finite" else math.inf,
        "closed form",
    )


def harmonics(mi):
    d = mi.Vector3f([0, 0, 1, 0], [0, 0, 0, 1], [1, -1, 0, 0])
    dr.enable_grad(d)
    total = sum(encode_direction(d, 4))
    dr.backward(total)
    yield Row(
        "directions along the axes",
        "poles and equator",
        "harmonics and their derivatives",
        all_finite(values(total), values(dr.grad(d))),
        "finite",
    )
