"""Test scene: a room of 6 x 4 x 3 m with a sign and a stand that occludes it from one side, and participants."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from nerg_mi.tracking.rays import Rays

SIGN = np.array([[4.0, 1.5, 1.0], [4.2, 2.5, 2.0]])
STAND = np.array([[2.5, 1.0, 0.0], [2.9, 2.0, 2.2]])
ROOM = np.array([[0.0, 0, 0], [6, 4, 3]])

CUBE = """<shape type="cube" id="{name}"><transform name="to_world"><scale x="{a}" y="{b}" z="{c}"/>
<translate x="{x}" y="{y}" z="{z}"/></transform><bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>"""


def cube(name: str, corners: np.ndarray) -> str:
    half, middle = (corners[1] - corners[0]) / 2, corners.mean(axis=0)
    return CUBE.format(name=name, **dict(zip("abc", half)), **dict(zip("xyz", middle)))


def write_place(folder: Path, gaze: bool = True) -> Path:
    """Write ``scene.xml``, areas.json and, optionally, a gaze field to ``folder``."""
    import mitsuba as mi

    from tests.plugins import fields

    mi.set_variant("llvm_ad_rgb")
    inside = ""
    if gaze:
        fields.gaze(folder / "gaze.safetensors")
        inside = '<volume name="gaze" type="gazefield"><string name="filename" value="gaze.safetensors"/></volume>'
    integrator = f'<integrator type="nerg">{inside}</integrator>' if gaze else '<integrator type="path"/>'
    shapes = "".join(cube(n, c) for n, c in (("room", ROOM), ("sign", SIGN), ("stand", STAND)))
    (folder / "scene.xml").write_text(f'<scene version="3.0.0">{integrator}{shapes}</scene>')
    areas = [
        {"name": "the sign", "min": SIGN[0].tolist(), "max": SIGN[1].tolist()},
        {"name": "the stand", "shape": "stand"},
        {"name": "both", "parts": ["the sign", "the stand"]},
    ]
    (folder / "areas.json").write_text(json.dumps({"regions": areas}))
    return folder / "scene.xml"


def people(count: int = 6, each: int = 80, seed: int = 0, cohorts: bool = True) -> Rays:
    """Participants who walk in the western half and mostly look east, sampled five times a second."""
    rng = np.random.default_rng(seed)
    n = count * each
    person = np.repeat(np.arange(count), each)
    origin = np.column_stack([rng.uniform(0.3, 2.2, n), rng.uniform(0.3, 3.7, n), np.full(n, 1.6)])
    d = rng.normal((1.0, 0, 0), 0.35, (n, 3))
    t = np.tile(0.2 * np.arange(each), count)
    shuffled = rng.permutation(n)
    rays = Rays(
        t,
        person,
        tuple(f"name {k}" for k in range(count)),
        origin,
        d / np.linalg.norm(d, axis=1, keepdims=True),
        np.ones(n),
        cohort=person % 2 if cohorts else None,
        cohorts=("even", "odd") if cohorts else (),
    )
    return rays.select(shuffled)


def first_box(o: np.ndarray, d: np.ndarray) -> tuple[str, float]:
    """Return the first surface on a ray and its distance, plane by plane."""
    result = ("room", np.inf)
    for name, box in (("room", ROOM), ("sign", SIGN), ("stand", STAND)):
        near, far = -np.inf, np.inf
        for axis in range(3):
            a, b = sorted((box[:, axis] - o[axis]) / d[axis])
            near, far = max(near, a), min(far, b)
        at = far if name == "room" else near
        if near < far and at > 0 and at < result[1]:
            result = name, float(at)
    return result
