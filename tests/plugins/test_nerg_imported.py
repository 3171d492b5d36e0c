"""An imported checkpoint of the paper's authors, at their sizes: `nerg` against NumPy on the state dictionary."""

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.formats.fields import save_gaze, save_radiance
from nerg_mi.formats.torch_ngp import read_nerg
from nerg_mi.maths.color import decode_srgb
from tests.formats.test_torch_ngp import save_nerg as save
from tests.reference import march_numpy
from tests.reference import torch_ngp_numpy as reference

from .scenes import camera, center_rays, named, plugin, render, still, stored

pytestmark = pytest.mark.usefixtures("torch")
SIZE, STEP = 6, 0.02


def expected(state, nerf, bound, origins, directions, eye):
    """Colour, depth, opacity, gaze, emit and capture of each ray, marched with the kernel's occupancy bits as the only
    skipping."""
    out = []
    for o, d in zip(origins, directions):
        near, far = march_numpy.box(o, d, [-bound] * 3, [bound] * 3)
        borders = march_numpy.steps(max(near, 0), far, STEP)
        middles = o + d * (borders[:-1] + np.diff(borders) / 2)[:, None]
        seen = reference.occupied(nerf["density_bitfield"], bound, middles)
        sigma, color = np.zeros(len(seen)), np.zeros((len(seen), 3))
        sigma[seen], color[seen], _ = reference.nerf(
            nerf, bound, middles[seen], np.tile(d.astype(np.float32), (seen.sum(), 1))
        )
        tau, depth, _, total, _ = march_numpy.march(lambda p, s=sigma: s, o, d, borders, lambda p, c=color: c)
        alpha = -np.expm1(-tau)
        p_d = o + d * depth
        r_o = (p_d - eye) / np.linalg.norm(p_d - eye)
        g = reference.gaze(state, bound, *(np.float32(x)[None] for x in (p_d, eye, r_o)))
        out.append(np.concatenate([alpha * decode_srgb(total / alpha), [depth, alpha], [x.item() for x in g]]))
    return np.array(out)


def smooth(state, finest):
    """Attenuate fine levels as training does: white noise at 4096 cells would show the last bit of every position."""
    where, levels = state["encoder.offsets"], len(state["encoder.offsets"]) - 1
    for level in range(levels):
        state["encoder.embeddings"][where[level] : where[level + 1]] *= (16 / finest) ** (level / (levels - 1))


@pytest.mark.nightly
@pytest.mark.parametrize("bound, aligned", [(2, True), (5, False)])
def test01_render_imported_checkpoint(rgb, tmp_path, bound, aligned):
    rng = np.random.default_rng(bound)
    nerf = reference.nerf_state(bound, rng, filled=0.2)
    state = reference.gaze_state(bound, rng)
    smooth(nerf, 2048 * bound)
    smooth(state, 256 * bound)
    field, gaze, origin = read_nerg(save(tmp_path / "nerg.pth", state, nerf=nerf), ns)
    save_radiance(field, tmp_path / "field.safetensors", origin)
    save_gaze(gaze, tmp_path / "gaze.safetensors", origin)

    eye = np.array([0.4, 0.3, -1.5]) if aligned else np.array([1.1, -0.7, 0.6])
    how = {"step": STEP, "surface_opacity": 0.0, "color_cutoff": 0.0, "stop": 0.0}
    if not aligned:
        place = rgb.ScalarTransform4f().translate(eye.tolist())
        how |= {"observer": {"type": "perspective", "to_world": place}, "occlusion": False}
    volumes = {"field": stored("nerf", tmp_path / "field.safetensors")}
    volumes["gaze"] = stored("gazefield", tmp_path / "gaze.safetensors")
    integrator = plugin("nerg", depth="expected", aovs="depth,opacity,gaze,emit,capture", **volumes, **how)
    sensor = still(camera(rgb, (0.4, 0.3, -1.5), (0.1, 0, 0.4), size=SIZE, fov=60, near_clip=0.01))
    ray = center_rays(rgb, sensor)
    origins, directions = (np.array(v, np.float64).T for v in (ray.o, ray.d))

    image = render(rgb, integrator, sensor)
    got = named(rgb, image, integrator)
    flat = np.concatenate(
        [image[..., :3]] + [got[k][..., None] for k in ("depth.T", "opacity.Y", "gaze.Y", "emit.Y", "capture.Y")], -1
    ).reshape(SIZE**2, -1)
    true = expected(state, nerf, bound, origins, directions, eye)
    assert true[:, 4].min() > 0.2 and np.ptp(true[:, 5]) > 0.1
    scale = np.abs(true).max(0)
    error = np.sort((np.abs(flat - true) / scale).max(1))
    # A sample that rounding moves across a cell face changes the result by a whole step: for at most one ray.
    assert np.median(error) < 1e-5 and error[-2] < 1e-4 and error[-1] < 0.1
