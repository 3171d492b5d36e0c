"""Digital twin of the demo store: ``twin.xml`` with two small meshes, and exact ray casts.

``twin.ply`` stores a linear reflectance per face (mesh attribute ``face_color``), ``twin_lights.ply`` the ceiling
panels. Mitsuba renders ``twin.xml`` with its ``path`` integrator; units are metres, z up.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from nerg_mi.files.atomic import write_text
from nerg_mi.formats.ply import write_columns

FOLDER = Path(__file__).resolve().parent
TWIN_XML = FOLDER / "twin.xml"

# Reflectances exclude black and white: interreflection keeps the light soft, and every texel has a gradient.
ALBEDO_RANGE = (0.03, 0.82)
PANEL_RADIANCE = 7.0

XML = """<!-- The demo store as shapes. Metres, z up. Made by nerg_mi.scenes.store.make. -->
<scene version="3.0.0">
    <default name="spp" value="64"/>
    <default name="width" value="480"/>
    <default name="height" value="360"/>

    <integrator type="path" id="integrator">
        <integer name="max_depth" value="6"/>
    </integrator>

    <sensor type="perspective" id="camera">
        <float name="fov" value="78"/>
        <string name="fov_axis" value="x"/>
        <float name="near_clip" value="0.01"/>
        <float name="far_clip" value="100"/>
        <transform name="to_world">
            <lookat origin="7.4, 0.5, 2.2" target="3.2, 3.6, 0.9" up="0, 0, 1"/>
        </transform>
        <sampler type="independent">
            <integer name="sample_count" value="$spp"/>
        </sampler>
        <film type="hdrfilm">
            <integer name="width" value="$width"/>
            <integer name="height" value="$height"/>
            <rfilter type="box"/>
            <string name="component_format" value="float32"/>
            <string name="pixel_format" value="rgb"/>
        </film>
    </sensor>

    <shape type="ply" id="store">
        <string name="filename" value="twin.ply"/>
        <boolean name="face_normals" value="true"/>
        <bsdf type="twosided">
            <bsdf type="diffuse">
                <texture type="mesh_attribute" name="reflectance">
                    <string name="name" value="face_color"/>
                </texture>
            </bsdf>
        </bsdf>
    </shape>

    <shape type="ply" id="lights">
        <string name="filename" value="twin_lights.ply"/>
        <boolean name="face_normals" value="true"/>
        <bsdf type="diffuse">
            <rgb name="reflectance" value="0.8"/>
        </bsdf>
        <emitter type="area">
            <rgb name="radiance" value="{r:.2f}, {g:.2f}, {b:.2f}"/>
        </emitter>
    </shape>
</scene>
"""


def _write_ply(path: Path, quads: np.ndarray, colors: np.ndarray | None) -> None:
    """Write a binary PLY of quads (N, 4, 3), each as two triangles; ``colors`` (N, 3) become the attribute
    ``face_color``.
    """
    corners = np.round(quads.reshape(-1, 3), 5)
    vertices, index = np.unique(corners, axis=0, return_inverse=True)
    index = index.reshape(-1, 4)
    triangles = index[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    # Mitsuba groups the face properties color_0..2 into the attribute face_color.
    tints = {} if colors is None else {f"color_{k}": np.repeat(colors[:, k], 2) for k in range(3)}
    write_columns(path, dict(zip("xyz", vertices.T)), triangles, tints)


def write_twin(layout, folder=FOLDER) -> list[Path]:
    """Write twin.xml, twin.ply and twin_lights.ply of a `StoreLayout` into a folder; returns their paths."""
    folder = Path(folder)
    _write_ply(folder / "twin.ply", layout.quads, np.clip(layout.colors, *ALBEDO_RANGE))
    _write_ply(folder / "twin_lights.ply", layout.lights, None)
    tint = PANEL_RADIANCE * np.array([1.0, 0.97, 0.92])
    write_text(folder / "twin.xml", XML.format(r=tint[0], g=tint[1], b=tint[2]))
    return [folder / n for n in ("twin.xml", "twin.ply", "twin_lights.ply")]


@lru_cache(maxsize=8)
def _load_scene(path: str, variant: str, stamp: float):
    import mitsuba as mi

    return mi.load_file(path)


def load_twin(path=TWIN_XML):
    """Load the twin as an `mi.Scene` of the active variant, once per file and variant."""
    import mitsuba as mi

    path = Path(path)
    if mi.variant() is None:
        raise RuntimeError('no Mitsuba variant is set; call mi.set_variant("llvm_ad_rgb") before loading the twin')
    if not path.exists():
        raise FileNotFoundError(
            f'"{path}" is missing; create it with: python -m nerg_mi.scenes.store.make --stage twin'
        )
    return _load_scene(str(path), mi.variant(), path.stat().st_mtime)


def _make_rays(origins, directions, maxt=None):
    import mitsuba as mi

    o = np.ascontiguousarray(np.asarray(origins, np.float32).reshape(-1, 3).T)
    d = np.ascontiguousarray(np.asarray(directions, np.float32).reshape(-1, 3).T)
    n = max(o.shape[1], d.shape[1])
    o, d = (np.ascontiguousarray(np.broadcast_to(v, (3, n))) for v in (o, d))
    ray = mi.Ray3f(mi.Point3f(o), mi.Vector3f(d))
    if maxt is not None:
        ray.maxt = mi.Float(np.ascontiguousarray(np.broadcast_to(np.asarray(maxt, np.float32).ravel(), (n,))))
    return ray, n


RAYS_PER_LAUNCH = 1 << 21  # rays per launch, which limits the memory of large queries


def cast_rays(origins, directions, scene=None) -> np.ndarray:
    """Return the distance in metres from origins (N, 3) along unit directions (N, 3) to the twin; float64 (N,), inf on
    a miss.

    A single origin or direction is broadcast. ``scene`` replaces the twin of the store.
    """
    scene = load_twin() if scene is None else scene
    o, d = np.broadcast_arrays(np.atleast_2d(origins), np.atleast_2d(directions))
    out = np.empty(len(o))
    for a in range(0, len(o), RAYS_PER_LAUNCH):
        ray, n = _make_rays(o[a : a + RAYS_PER_LAUNCH], d[a : a + RAYS_PER_LAUNCH])
        t = scene.ray_intersect_preliminary(ray, coherent=False).t
        out[a : a + n] = np.asarray(t, np.float64)
    return out


def is_visible(origins, points, scene=None, tolerance: float = 1e-3) -> np.ndarray:
    """Return whether each of points (N, 3) is visible from origins (N, 3), (N,) bool.

    The last ``tolerance`` metres before the point are not tested, so that a point on a surface is not occluded by it.
    """
    scene = load_twin() if scene is None else scene
    o, p = np.broadcast_arrays(np.atleast_2d(origins), np.atleast_2d(points))
    out = np.empty(len(o), bool)
    for a in range(0, len(o), RAYS_PER_LAUNCH):
        offset = (p[a : a + RAYS_PER_LAUNCH] - o[a : a + RAYS_PER_LAUNCH]).astype(np.float64)
        length = np.linalg.norm(offset, axis=1)
        ray, n = _make_rays(
            o[a : a + RAYS_PER_LAUNCH], offset / np.maximum(length, 1e-12)[:, None], np.maximum(length - tolerance, 0.0)
        )
        out[a : a + n] = ~np.asarray(scene.ray_test(ray), bool)
    return out
