"""Another quadrature rule is one object: registered, it marches, renders, is differentiated, and stands wherever rules
are offered."""

from types import SimpleNamespace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.evaluation import study
from nerg_mi.maths.arrays import quotient
from nerg_mi.transport.march import march
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.medium import LocalRay
from nerg_mi.transport.quadrature import RULES, Step, linear_share
from tests.plugins.scenes import camera, channels, constant, named, render


class Simpson:
    """Three samples a step, which integrate cubic densities exactly."""

    name = "simpson"
    summary = "three samples a step"
    in_cells = False

    def start(self, Float):
        return None

    def step(self, medium, ray, t, delta, t_next, carry, active, colored) -> Step:
        first, middle, last = (medium.density(ray.o + ray.d * (t + s * delta), active) for s in (0, 0.5, 1))
        dtau = dr.select(active, (first + 4 * middle + last) * delta / 6, 0)
        p = ray.o + ray.d * (t + 0.5 * delta)
        return Step(
            dtau,
            linear_share(first * delta, last * delta),
            lambda missing: delta * quotient(missing, dr.select(dtau > 0, dtau, 1)),
            lambda painter, lit: painter.paint(medium, medium.density_features(p, lit)[1], p, ray.w, lit),
            None,
            dr.select(active, 3.0, 0.0),
        )


@pytest.fixture
def simpson():
    rule = RULES.register(Simpson())
    yield rule
    RULES.unregister("simpson")


class Cubic:
    """Density 2 + z³ times ``gain``."""

    occupancy = cells = step = hits = None

    def __init__(self, gain=1.0):
        self.gain = ns.Float(gain)

    def parameters(self):
        return [self.gain]

    def density(self, p, active):
        return dr.select(active, self.gain * (2 + p.z * p.z * p.z), 0)


def along_z(medium, rule, n):
    z, t0, t1 = ns.Array3f(0, 0, 1), dr.opaque(ns.Float, 0), dr.opaque(ns.Float, 2)
    settings = MarchSettings(2 / n, stop=0, quadrature=rule)
    return march(medium, LocalRay(ns.Array3f(0), z, z, t0, t1), t0, t1, True, settings, count=True)


def test01_it_marches(simpson):
    found = along_z(Cubic(), "simpson", 1)
    # ∫ 2 + z³ over [0, 2]
    assert np.isclose(found.tau[0], 8, rtol=1e-5) and found.density_evals[0] == 3
    assert abs(along_z(Cubic(), "constant", 1).tau[0] - 8) > 1


def test02_it_is_differentiated(simpson):
    medium = Cubic()
    dr.enable_grad(medium.gain)
    dr.backward(along_z(medium, "simpson", 5).tau)
    assert np.isclose(dr.grad(medium.gain)[0], 8, rtol=1e-5)


def test03_it_renders(rgb, simpson):
    sensor = camera(rgb, (0.5, 0.4, -3), (0.5, 0.5, 0.5))
    tint = {"type": "constvolume", "value": 0.25}
    pictures, counts = [], []
    for rule in ("simpson", "constant"):
        asked = constant(2.0, color=tint, quadrature=rule, step=0.05, aovs="opacity,depth,density_evals")
        picture = render(rgb, asked, sensor)
        pictures.append(picture[..., :-1])
        counts.append(named(rgb, picture, asked)["density_evals.Y"])
    assert counts[0].any() and np.array_equal(counts[0], 3 * counts[1])
    # In homogeneous matter every rule is exact.
    assert pictures[1][..., :3].max() > 0.1 and np.allclose(*pictures, rtol=1e-4, atol=1e-6)


def test04_shapes_and_other_depths_go_with_it(rgb, simpson):
    plate = {"type": "rectangle", "to_world": rgb.ScalarTransform4f().translate([0, 0, 0.7])}
    for depth in ("median", "refined"):
        found = [
            channels(rgb, constant(5.0, quadrature=rule, depth=depth, step=0.03), plate=plate)["depth.T"]
            for rule in ("simpson", "constant")
        ]
        assert found[1].any() and np.allclose(*found, rtol=1e-4)


def test05_it_is_offered_wherever_rules_are(rgb, simpson):
    subject = SimpleNamespace(marched=True, hits=False, extent=1.0, has_gaze=True, normalized=False, resampled=True)
    assert {s.params.get("quadrature") for s in study.settings(subject)} >= {"constant", "linear", "simpson"}
    assert RULES.manual().endswith("``simpson``: three samples a step.")


def test06_without_it_the_integrator_says_what_there_is(rgb):
    with pytest.raises(RuntimeError, match='"quadrature"'):
        rgb.load_dict(constant(quadrature="simpson"))


def test07_the_manual_has_every_rule(rgb):
    from nerg_mi.plugins import nerg

    assert all(rule.summary in nerg.__doc__ for rule in RULES) and "{" not in nerg.__doc__.split("math")[0]
