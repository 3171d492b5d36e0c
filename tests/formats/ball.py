"""A field whose surface is known: what meshes, points and volumes are made of in the tests."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np

from nerg_mi.maths.geometry import Box

CENTER, RADIUS = np.array([1.2, 1.0, 0.9]), 0.6


class Ball:
    """Stands in for a radiance field: density in a ball, a speck beside it, and colour from position and direction."""

    def __init__(self, occupancy=None, speck=False, hole=False, color_space="srgb", sharp=200.0):
        self.box, self.occupancy, self.color_space = Box((0, 0, 0), (2.4, 2, 1.8)), occupancy, color_space
        self.ns = ns
        self.speck, self.hole, self.sharp = speck, hole, sharp

    def density(self, p, active=True):
        to = lambda c: dr.norm(p - ns.Array3f(*c))
        sigma = self.sharp * dr.exp(60 * (RADIUS - to(CENTER.tolist())))
        if self.speck:
            sigma += 1e3 * dr.exp(200 * (0.1 - to([0.2, 0.2, 0.2])))
        if self.hole:
            # A shaft along z about one line of lattice points.
            sigma = dr.select(dr.sqrt((p.x - 1.225) ** 2 + (p.y - 1.025) ** 2) < 0.02, 0, sigma)
        return dr.select(active & self.box.contains(p), dr.minimum(sigma, 1e4), 0)

    def density_features(self, p, active=True):
        return self.density(p, active), [p.x, p.y, p.z]

    def color(self, features, d):
        return ns.Array3f(features[0] / 2.4, 0.5 + 0.1 * d.z, 0.25)
