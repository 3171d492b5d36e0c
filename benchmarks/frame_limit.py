"""How near a whole frame comes to the same work by hand, and what two other ways to colour it would take.

    python benchmarks/frame_limit.py [--width 640] [--height 360] [--runs 9] [--threads 2] [--page PAGE]

The demo store, colour, depth and gaze of an observer who is not the camera. The frame's evaluations are counted, and
each kind is timed by ``density_limit.cpp``, on a quarter of a million points in full packets: densities with the
features that colours need and without, networks of colour, of emit and of capture, and emit's encoding at the cost a
level of the density's. Their sum is what is compared; stepping, compositing, activations and what a frame costs once
are in ours alone. Networks by hand are compared with float64, densities with ours, before anything is timed.

The second table are the camera's rays alone, at the field's steps: without colour, with it, with the colour network
asked for the same number of points in full packets, and of a deferred field of the same sizes, which asks once a ray.
Errors are against a colour for every sample; what a deferred field costs in colours is for its training to say
(`fox_radiance.py --deferred`).
"""

from __future__ import annotations

import argparse
import ctypes
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import density_limit
import nerg_mi as nerg
import torch_frames
from density_limit import BLOCK, HAND, Limit
from nerg_mi.field.constant_weights import set_constant_weights
from nerg_mi.jobs.demo import store_scene
from output import print_table, write_rows
from timing import in_turns, median, spread

import numpy as np

POINTS = 1 << 18
_ROWS = 4


class _Network(ctypes.Structure):
    _fields_ = (("weights", ctypes.c_void_p * 4), ("sizes", ctypes.c_int32 * 5), ("layers", ctypes.c_int32))


class HandNetwork:
    """A network of ReLU layers without biases, by hand; ``weights``: (outputs, inputs) of each layer."""

    def __init__(self, weights: list[np.ndarray], library: ctypes.CDLL, threads: int):
        self.library, self.threads, self.outputs = library, threads, len(weights[-1])
        # Its rows go in fours.
        pad = lambda w, rows, columns: np.pad(w, ((0, rows - len(w)), (0, columns - w.shape[1])))
        rows = [-(-len(w) // _ROWS) * _ROWS for w in weights]
        columns = [weights[0].shape[1], *rows[:-1]]
        self.weights = [np.ascontiguousarray(pad(w, r, c), np.float32) for w, r, c in zip(weights, rows, columns)]
        sizes, where = [columns[0], *rows], [w.ctypes.data for w in self.weights]
        self.network = _Network(
            (ctypes.c_void_p * 4)(*where), (ctypes.c_int32 * 5)(*sizes, *[0] * (5 - len(sizes))), len(weights)
        )

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        """Outputs (outputs, N) of ``inputs`` (inputs, N), float32, N a multiple of 64."""
        out = np.empty((len(self.weights[-1]), inputs.shape[1]), np.float32)
        at = (ctypes.c_void_p(inputs.ctypes.data), ctypes.c_void_p(out.ctypes.data), ctypes.c_int64(out.shape[1]))
        if self.library.network(ctypes.byref(self.network), *at, self.threads):
            raise ValueError("the hand-written program does not know a network of this size, or so many points")
        return out[: self.outputs]


def counted(width: int, height: int) -> dict[str, float]:
    """Evaluations a pixel of the store's frame."""
    import mitsuba as mi

    def mean(aovs: str, last: int) -> np.ndarray:
        scene = nerg.Scene.load(store_scene(), width=width, height=height, spp=1, aovs=aovs).mitsuba
        return np.array(mi.render(scene, sensor=0, spp=1, seed=0))[..., -last:].mean(axis=(0, 1))

    camera = mean("depth,density_evals,color_evals", 2)
    both = mean("depth,visibility,density_evals,gaze,gaze_evals", 4)
    # Counted are both networks of each evaluation.
    return {"camera": camera[0], "colour": camera[1], "observer": both[1] - camera[0], "gaze": both[3] / 2}


def hand_works(field, gaze, library, threads: int, runs: int) -> dict[str, float]:
    """Nanoseconds of processor time of each kind of evaluation by hand, checked against ours."""
    rng, limit = np.random.default_rng(0), Limit(field, library, threads)
    points = density_limit.marched_points(field, *torch_frames.camera_rays(320, 180), POINTS)
    weights = lambda net: [np.array(w, np.float32) for w in net.weights]
    with_features = weights(field.density_net)
    nets = {
        "density net with features": with_features,
        "density net": [*with_features[:-1], with_features[-1][:1]],
        "colour": weights(field.color_net),
        "emit net": weights(gaze.emit_net),
        "capture": weights(gaze.capture_net),
    }
    works: dict[str, Callable] = {"density": lambda: limit.density(points)}
    for name, layers in nets.items():
        by_hand = HandNetwork(layers, library, threads)
        inputs = rng.standard_normal((layers[0].shape[1], POINTS)).astype(np.float32)
        some, values = inputs[:, :BLOCK], inputs[:, :BLOCK].astype(np.float64)
        for k, w in enumerate(layers):
            values = w.astype(np.float64) @ (values if k == 0 else np.maximum(values, 0))
        off = np.abs(by_hand(np.ascontiguousarray(some)) - values).max() / np.abs(values).max()
        if not off < 1e-5:
            raise SystemExit(f"the {name} by hand is {off:.1e} off")
        works[name] = lambda by_hand=by_hand, inputs=inputs: by_hand(inputs)
    taken = {name: 1e9 * median(c for _, c in times) / POINTS for name, times in in_turns(works, runs).items()}
    encoding = (taken["density"] - taken["density net"]) / field.config.grid.levels
    return {
        "density": taken["density"],
        "density and features": taken["density"] + taken["density net with features"] - taken["density net"],
        "colour": taken["colour"],
        "gaze": taken["emit net"] + encoding * gaze.config.grid.levels + taken["capture"],
    }


def frame_table(width: int, height: int, field, gaze, threads: int, runs: int) -> list[list[str]]:
    """Rows of the whole frame beside the sum by hand, and of that of a deferred field of the same sizes. Raises
    ``RuntimeError`` where no compiler builds it."""
    from nerg_mi.formats.fields import save_radiance

    count, values = counted(width, height), {"width": width, "height": height, "spp": 1, "aovs": "depth,gaze"}
    with tempfile.TemporaryDirectory() as folder:
        by_hand = hand_works(field, gaze, density_limit.build(Path(folder)), threads, runs)
        path = Path(folder) / "deferred.safetensors"
        save_radiance(deferred_twin(field), path, {})
        frames = {
            f"frame{kind}{', constant weights' if constant else ''}": torch_frames.Ours(given, "depth", constant)
            for kind, given in (("", values), (", deferred field", {**values, "field": path}))
            for constant in (False, True)
        }
    kinds = (
        ("densities and features of the camera's rays", "camera", "density and features"),
        ("colours", "colour", "colour"),
        ("densities of the observer's rays", "observer", "density"),
        ("gaze: emit's encoding and both networks", "gaze", "gaze"),
    )
    rows, total = [], 0.0
    for what, counts, kind in kinds:
        us = 1e-3 * count[counts] * by_hand[kind]
        total += us
        rows.append([what, f"{count[counts]:.2f}", f"{by_hand[kind]:.1f}", f"{us:.3f}", ""])
    rows.append([f"sum, {HAND}", "", "", f"{total:.3f}", "1.00"])
    for name, times in in_turns(frames, runs).items():
        us = 1e6 * median(c for _, c in times) / (width * height)
        rows.append([name, "", "", f"{us:.3f}", "" if "deferred" in name else f"{us / total:.2f}"])
    return rows


def deferred_twin(field):
    """A deferred field of the same weights, which cost what those of one that was trained so do: its colours mean
    nothing."""
    from dataclasses import replace

    from nerg_mi.field.radiance import RadianceField

    config, parts = replace(field.config, deferred=True), (field.grid, field.density_net, field.color_net)
    made = RadianceField(config, field.box, *parts, occupancy=field.occupancy)
    made.march_step, made.march_growth = field.march_step, field.march_growth
    return made


def colour_table(width: int, height: int, field, runs: int) -> list[list[str]]:
    """Rows of the camera's rays, coloured in several ways."""
    from dataclasses import replace

    from nerg_mi.transport.features import color_painter
    from nerg_mi.transport.march.march import march
    from nerg_mi.transport.media.field import FieldMedium
    from nerg_mi.transport.media.painting import ColorPainter
    from nerg_mi.transport.place import Place
    from nerg_mi.transport.trace import default_settings

    import drjit as dr
    import mitsuba as mi

    medium, once = FieldMedium(field), FieldMedium(deferred_twin(field))
    settings = default_settings(Place(medium))
    o, d = (mi.Vector3f(*map(mi.Float, np.asarray(v, np.float32).T)) for v in torch_frames.camera_rays(width, height))
    ray, pixels = medium.local(mi.Point3f(o), d), width * height

    def marched(painter, cutoff: float, count: bool = False):
        near = dr.maximum(ray.t_near, 0)
        own = replace(settings, color_cutoff=cutoff)
        return march(medium, ray, near, ray.t_far, mi.Bool(True), own, color=painter, count=count)

    def depth():
        dr.eval(marched(None, 0).half)

    def colour(cutoff: float):
        out = mi.Color3f(marched(ColorPainter(mi.Color3f), cutoff).color)
        dr.eval(out)
        return out

    def deferred():
        painter, active = color_painter(once, mi.Color3f), mi.Bool(True)
        found = march(once, ray, dr.maximum(ray.t_near, 0), ray.t_far, active, settings, color=painter)
        dr.eval(painter.color(once, found.color, found.opacity, ray, active))

    asked = round(float(np.mean(marched(ColorPainter(mi.Color3f), settings.color_cutoff, True).color_evals)) * pixels)
    rng = np.random.default_rng(0)
    features = [mi.Float(v) for v in rng.standard_normal((field.config.geometry, asked)).astype(np.float32)]
    along = dr.normalize(mi.Vector3f(*map(mi.Float, rng.standard_normal((3, asked)).astype(np.float32))))
    dr.eval(features, along)

    def packed():
        dr.eval(field.color(features, along))

    exact = np.array(colour(0.0))
    ways = {
        "no colour": (depth, None),
        "a colour for every sample": (lambda: colour(0.0), 0.0),
        "color_cutoff 1e-3 (default)": (lambda: colour(settings.color_cutoff), settings.color_cutoff),
        "color_cutoff 1e-2": (lambda: colour(1e-2), 1e-2),
        "color_cutoff 0.1": (lambda: colour(0.1), 0.1),
        "the default's colours alone, in full packets": (packed, None),
        "deferred": (deferred, None),
    }
    settle = lambda work: lambda: (work(), dr.sync_thread())
    rows = []
    for constant in (False, True):
        set_constant_weights(field, constant)
        taken = in_turns({name: settle(work) for name, (work, _) in ways.items()}, runs)
        for name, times in taken.items():
            work, cutoff = ways[name]
            each = [1e6 * c / pixels for _, c in times]
            evaluations, db = "", ""
            if cutoff is not None:
                found = marched(ColorPainter(mi.Color3f), cutoff, True)
                evaluations = f"{np.mean(found.color_evals):.2f}"
            elif work is deferred:
                evaluations = "1.00"
            elif work is packed:
                evaluations = f"{asked / pixels:.2f}"
            if cutoff is not None and cutoff > 0:
                db = f"{-10 * np.log10(np.mean((np.array(work()) - exact) ** 2)):.1f}"
            weights = "constant" if constant else "in memory"
            rows.append([name, weights, evaluations, f"{median(each):.3f}", spread(each), db])
    set_constant_weights(field, False)
    return rows


FRAME = ("what", "a pixel", "ns of CPU", "us of CPU a pixel", "times by hand")
COLOUR = ("camera's rays", "weights", "colours a pixel", "us of CPU a pixel", "quartiles", "dB")


def main(argv=None) -> None:
    import mitsuba as mi

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=360)
    parser.add_argument("--runs", type=int, default=9)
    parser.add_argument("--threads", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--page", type=Path, help="page of the documentation that the tables are put into")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/frame_limit"))
    args = parser.parse_args(argv)
    mi.set_variant("llvm_ad_rgb")
    from nerg_mi.field.backend import namespace
    from nerg_mi.formats.fields import load_gaze, load_radiance

    import drjit as dr

    dr.set_thread_count(args.threads)
    args.out.mkdir(parents=True, exist_ok=True)
    folder, ns = store_scene().parent, namespace("llvm_ad_rgb")
    field = load_radiance(folder / "store.safetensors", ns)[0]
    gaze = load_gaze(folder / "shoppers.safetensors", ns)[0]
    if density_limit.compiler() is None:
        raise SystemExit("no C++ compiler was found (g++, clang++), and nothing to compare with")
    rows = frame_table(args.width, args.height, field, gaze, args.threads, args.runs)
    print_table("A frame by hand", FRAME, rows, args.page)
    write_rows(args.out / "frame.csv", [dict(zip(FRAME, row)) for row in rows])
    rows = colour_table(args.width, args.height, field, args.runs)
    print_table("Ways to colour", COLOUR, rows, args.page)
    write_rows(args.out / "colour.csv", [dict(zip(COLOUR, row)) for row in rows])


if __name__ == "__main__":
    main()
