import drjit as dr
import drjit.llvm.ad as ns
import numpy as np

from nerg_mi.maths.sphere import harmonics
from nerg_mi.transport.splat_medium import SplatArrays
from tests.formats.splats.writers import random_splats
from tests.reference.splats import peaks
from tests.transport.media.splats.scenes import rays


def test_peaks_and_colors_are_those_of_float64():
    splats = random_splats(30, degree=3)
    arrays = SplatArrays(splats, ns)
    o, d = rays(200)
    place = np.random.default_rng(0).integers(0, 30, 200)
    index = np.array(arrays.order)[place]
    t, absorbed, distance = arrays.peak(ns.UInt32(place), ns.Array3f(o.T), ns.Array3f(d.T), True)
    wanted = [v[np.arange(200), index] for v in peaks(splats, o, d, extent=np.inf)]
    assert np.allclose(t, wanted[0], atol=1e-5) and np.allclose(absorbed, wanted[1], atol=1e-5)
    assert np.allclose(np.minimum(splats.opacities[index] * np.exp(-0.5 * np.array(distance)), 0.9999), wanted[1])
    color = np.stack([np.array(c) for c in arrays.color(ns.UInt32(place), ns.Array3f(d.T), True)], axis=1)
    seen = np.einsum("rk,rkc->rc", harmonics(d, 3), splats.harmonics[index].astype(float)) + 0.5
    assert np.allclose(color, np.maximum(seen, 0), atol=1e-5)


def test_what_is_set_is_packed_again():
    arrays = SplatArrays(random_splats(5, degree=0), ns)
    before, colors = arrays.lower.copy(), arrays.colors
    arrays.centers = arrays.centers + 1
    arrays.pack()
    assert np.allclose(arrays.lower, before + 1, atol=1e-6) and next(iter(arrays.parameters())) == "centers"
    assert dr.width(colors) == 4 * 5 and dr.width(arrays.shapes) == 16 * 5
    # Of any length: a rotation is a direction.
    turned = np.array(arrays.shapes)
    arrays.rotations = arrays.rotations * 3
    arrays.pack()
    assert np.allclose(arrays.shapes, turned, rtol=1e-5, atol=1e-5)
