"""What a scene does not need is not computed: counted in operations traced and evaluations made, never in time."""

import subprocess
import sys

import numpy as np
import pytest

from nerg_mi.evaluation.study import traced_operations

from . import fields
from .scenes import camera, channels, look_at, observer_at, straight, with_field, with_gaze

COUNTS = "density_evals,color_evals,gaze_evals"


def operations(mi, integrator, sensor=None):
    scene = mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor or camera(mi)})
    mi.render(scene, spp=1)  # set-up that happens once is not counted
    return traced_operations(lambda: mi.render(scene, spp=1))


def test01_no_colour(rgb, files):
    dark, lit = (with_field(files, radiance=r, aovs="depth,opacity") for r in (False, True))
    assert operations(rgb, dark) < 0.75 * operations(rgb, lit)
    evals = channels(rgb, with_field(files, radiance=False, aovs="density_evals,color_evals"))
    assert evals["density_evals.Y"].max() > 5 and not evals["color_evals.Y"].any()


def test02_nothing_asked_nothing_marched(rgb, files):
    nothing, depth = (operations(rgb, with_field(files, radiance=False, aovs=a)) for a in ("", "depth"))
    assert nothing < 0.1 * depth


def test03_no_gaze_unless_asked(rgb, files):
    without, unasked, asked = (
        operations(rgb, i)
        for i in (
            with_field(files, aovs="depth,opacity"),
            with_gaze(files, "depth,opacity"),
            with_gaze(files, "depth,opacity,gaze"),
        )
    )
    assert unasked == without and asked > without + 300


def test04_an_aligned_observer_needs_no_second_march(rgb, files):
    sensor = camera(rgb, (0.5, 0.4, -3))
    none = with_gaze(files, "gaze,density_evals")
    here, there = (
        with_gaze(files, "gaze,density_evals", observer={"type": "perspective", "to_world": look_at(rgb, o)})
        for o in ((0.5, 0.4, -3), (-2, 0.3, -2))
    )
    a, b, c = (channels(rgb, i, sensor)["density_evals.Y"] for i in (none, here, there))
    assert np.array_equal(a, b) and c.sum() > 1.3 * a.sum()
    first, second, third = (operations(rgb, i, sensor) for i in (none, here, there))
    assert second < first + 60 and third > second + 300


def test05_without_occlusion_no_observer_march(rgb, files):
    observer = observer_at(rgb, -2, 0.3, -2)
    aligned = channels(rgb, with_gaze(files, "gaze,density_evals"))["density_evals.Y"]
    off = with_gaze(files, "gaze,density_evals", observer=observer, occlusion=False)
    assert np.array_equal(channels(rgb, off)["density_evals.Y"], aligned)
    assert operations(rgb, off) + 300 < operations(rgb, {**off, "occlusion": True})


def test06_half_a_gaze_field_for_half_a_variant(rgb, files, tmp_path):
    fields.gaze(tmp_path / "emit.safetensors", "emit")
    both = with_gaze(files, "gaze,gaze_evals")
    emit = {**both, "gaze": {"type": "gazefield", "filename": str(tmp_path / "emit.safetensors")}}
    assert operations(rgb, emit) + 100 < operations(rgb, both)
    assert channels(rgb, emit)["gaze_evals.Y"].max() == 1 and channels(rgb, both)["gaze_evals.Y"].max() == 2


def test07_a_fixed_observers_map_is_marched_once(rgb, files):
    integrator = with_gaze(files, "gaze", observer=observer_at(rgb, -2, 0.3, -2), visibility="map", map_height=32)
    scene = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": camera(rgb)})
    first, second = (traced_operations(lambda: rgb.render(scene, spp=1)) for _ in range(2))
    assert second + 300 < first
    params = rgb.traverse(scene)
    params["integrator.observer.to_world"] = rgb.Transform4f(look_at(rgb, (-2.1, 0.3, -2)))
    params.update()
    assert traced_operations(lambda: rgb.render(scene, spp=1)) > second + 300


@pytest.mark.parametrize("thickness", [1, 4])
def test08_empty_space_is_passed_over(rgb, thickness):
    # A sheet of some voxels in an empty grid of 64: what is marched is the sheet and a voxel on either side.
    data = np.zeros((64, 64, 64), np.float32)
    data[30 : 30 + thickness] = 0.01
    density = {"type": "gridvolume", "grid": rgb.VolumeGrid(data)}
    integrator = {"type": "nerg", "density": density, "step": 1 / 256, "aovs": COUNTS.rsplit(",", 1)[0]}
    evals = channels(rgb, integrator, straight(rgb, "perspective"))["density_evals.Y"].item()
    assert 4 * thickness <= evals <= 4 * (thickness + 2) + 2


def test09_what_lies_behind_an_opaque_surface_is_not_marched(rgb):
    data = np.full((64, 64, 64), 1e5, np.float32)
    density = {"type": "gridvolume", "grid": rgb.VolumeGrid(data)}
    integrator = {"type": "nerg", "density": density, "aovs": "density_evals"}
    assert channels(rgb, integrator, straight(rgb, "perspective"))["density_evals.Y"].item() == 1


def test10_rays_that_miss_cost_nothing(rgb, files):
    out = channels(rgb, with_gaze(files, COUNTS), camera(rgb, (0, 0, -3), (0, 5, -3)))
    assert not any(c.any() for c in out.values())


def test11_rendering_imports_neither_torch_nor_matplotlib_nor_scipy_stats(files):
    code = f"""
import sys, nerg_mi, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
scene = mi.load_dict({{"type": "scene", "integrator": {{"type": "nerg", "aovs": "depth,gaze",
    "field": {{"type": "nerf", "filename": r"{files / "field.safetensors"}"}},
    "gaze": {{"type": "gazefield", "filename": r"{files / "gaze.safetensors"}"}}}},
    "sensor": {{"type": "perspective", "film": {{"type": "hdrfilm", "width": 4, "height": 4}}}}}})
mi.render(scene, spp=1).numpy()
print([m for m in ("torch", "matplotlib", "scipy.stats") if m in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
