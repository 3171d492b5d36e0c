"""What the colour network of a radiance field is asked with, and how its answer becomes a colour.

At every sample of a ray, c(g, d) = sigmoid(color_net(Y(d), g)). A deferred field asks once a ray:

    C = α c(ḡ, d),   ḡ = Σ_i w_i g_i / α,   α = Σ_i w_i,   c(g, d) = sigmoid(l + color_net(Y(d), l, g_4..))

with l = logit(g_1..3) and w_i the weights of volume rendering, after Hedman et al. 2021 ("Baking Neural Radiance
Fields for Real-Time View Synthesis", section 3): the first three features are a diffuse colour in 0..1, which
composites as any colour does, and to which the network adds what depends on the direction. There colours are added,
here their logits, so that the sum stays in 0..1.
"""

from __future__ import annotations

import drjit as dr

from nerg_mi.maths.arrays import sigmoid
from nerg_mi.maths.types import Float

# How near to 0 and 1 a diffuse colour is taken before its logit.
_MARGIN = 1e-3


def point_features(outputs: list[Float], deferred: bool) -> list[Float]:
    """Features of points, of the ``outputs`` of the density net behind the log density: of a deferred field the first
    three become its diffuse colour, in 0..1."""
    return [*(sigmoid(x) for x in outputs[:3]), *outputs[3:]] if deferred else outputs


def mean_features(sums: list[Float], opacity: Float) -> list[Float]:
    """Features Σ w g / α of rays of ``opacity`` α that composited ``sums`` Σ w g; 0 where nothing absorbs."""
    # Its square, which derivatives have, stays finite.
    per = 1 / dr.maximum(opacity, 1e-12)
    return [s * per for s in sums]


def network_inputs(features: list[Float], deferred: bool) -> list[Float]:
    """What the colour net is given, behind the direction, for ``features``."""
    if not deferred:
        return features
    # Not clipped, which would hold black and white fast.
    inside = [dr.fma(1 - 2 * _MARGIN, f, _MARGIN) for f in features[:3]]
    return [*(dr.log(x / (1 - x)) for x in inside), *features[3:]]


def network_color(outputs: list[Float], inputs: list[Float], deferred: bool) -> list[Float]:
    """Colour (3 Floats in 0..1) of the colour net's ``outputs`` for its ``inputs`` (`network_inputs`)."""
    return [sigmoid(c + x) for c, x in zip(outputs, inputs)] if deferred else [sigmoid(c) for c in outputs]
