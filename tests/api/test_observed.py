"""One observer of a scene: what is known of them, and the density of their gaze."""

import drjit as dr
import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.api.query import ObserverOf


def test01_the_density_is_the_fields(scene, rgb):
    observer = ObserverOf(scene, np.float32((0.3, -3, 0.4)))
    p_od, r_o = rgb.Point3f(0.2, -0.5, 0.1), dr.normalize(rgb.Vector3f(-0.1, 2.5, -0.3))
    field = nerg.load_gaze(scene.integrator.children["gaze"].filename).network
    expected = field.evaluate(p_od, rgb.Point3f(0.3, -3, 0.4), r_o)[0]
    assert np.isclose(observer.density(p_od, observer.center, r_o, True)[0], expected[0], rtol=1e-5)


def test02_one_kernel_serves_all_observers(scene, rgb):
    points = rgb.Point3f([0.1, 0.2, 0.3], [-1, -1, -1], [0, 0, 0.1])
    kernels = []
    for eye in ((0.3, -3, 0.4), (2.5, -1, 0.5), (0, -2, 0)):
        observer = ObserverOf(scene, np.float32(eye))
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            dr.eval(observer.sees(points, True))
            kernels.append({k["hash"] for k in dr.kernel_history() if "hash" in k})
    assert kernels[0] and kernels[0] == kernels[1] == kernels[2]


def test03_without_a_gaze_field_there_is_no_density(files):
    observer = ObserverOf(nerg.make_scene(files / "field.safetensors"), np.float32((0, -3, 0)))
    with pytest.raises(ValueError, match="without a gaze field"):
        observer.density(None, None, None, True)
