"""Derivatives of pictures against central differences, for every quantity and parameter.

    python benchmarks/gradients.py [--depth median] [--case NAME] [--update docs/gradients.md]

One number moves each parameter along a fixed line (``gradients_cases.py``). Forward: derivatives of all pixels at once,
as ``mi.render`` gives them. Reverse: derivative of one weighted sum of the pixels of one quantity. Both against central
differences of pictures at two distances, extrapolated (Richardson); reverse also against the weighted sum of the
forward derivatives, which is the dot-product test and holds to rounding. Prints markdown; nothing passes or fails here.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from output import print_table

import numpy as np

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
    ``reverse`` against central differences, ``dot`` of one against the other. ``share``: numbers of the picture that
    have no kink within the differences' reach, which are those that count; ``doubt``: how far differences at both
    distances are apart."""

    forward: float
    reverse: float
    dot: float
    share: float
    doubt: float


def measure(mi, scene, case, quantities=QUANTITIES) -> dict:
    """``Entry`` of each quantity that the scene has, or None where it does not depend on the parameter."""
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
    # A kink within reach shows in the differences themselves: their two sides disagree by more than a smooth bend
    # would.
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
        # Relative to the sum of magnitudes: terms of both signs may cancel.
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


def errors(mi, only: str, depth: str):
    """The table of all cases, with surfaces at ``depth``."""
    import gradients_cases as g

    rows = []
    with tempfile.TemporaryDirectory() as folder:
        g.write_fields(mi, Path(folder))
        for case in g.cases():
            if only not in case.name:
                continue
            scene = mi.load_dict({"type": "scene", **g.SCENES[case.scene](mi, Path(folder), depth=depth)})
            rows.append([case.name, *summary(measure(mi, scene, case))])
            print(rows[-1], file=sys.stderr, flush=True)
    for name, reason in g.EXCLUDED.items():
        if only in name:
            rows.append([name, *(reason.get(q, "") for q in QUANTITIES), "", "", ""])
    head = ["with respect to", *QUANTITIES, "reverse against forward", "differences", "left out"]
    yield "Errors of derivatives", head, rows


def summary(found: dict) -> list[str]:
    text = lambda e: f"{e.forward:.0e} / {e.reverse:.0e}" if e else "none"
    cells = [text(found[quantity]) if quantity in found else "" for quantity in QUANTITIES]
    known = [e for e in found.values() if e]
    return [
        *cells,
        f"{max(e.dot for e in known):.0e}",
        f"{max(e.doubt for e in known):.0e}",
        f"{1 - min(e.share for e in known):.0%}",
    ]


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", default="", help="only cases whose name contains this")
    parser.add_argument("--depth", default="median", help="median, expected or refined")
    parser.add_argument("--update", type=Path, help="a document whose tables are replaced, heading by heading")
    args = parser.parse_args(argv)

    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    # A sensor's pose counts as not differentiable in Mitsuba, which says so on each of its updates.
    mi.set_log_level(mi.LogLevel.Error)
    for title, head, rows in errors(mi, args.case, args.depth):
        print_table(title, head, rows, args.update)


if __name__ == "__main__":
    main()
