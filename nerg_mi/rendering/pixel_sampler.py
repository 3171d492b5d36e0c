"""The random numbers of some pixels of a picture, without those of all others.

Mitsuba's ``independent`` sampler gives every sample of a picture its own PCG32 generator, whose state and stream are
the seed and the number of the sample, scrambled (Tiny Encryption Algorithm). Thus the numbers of any range of samples
can be had alone, and are those that they have in the whole picture.
"""

from __future__ import annotations

import functools
import re

from nerg_mi.maths.types import variant_types


def base_seed(sampler) -> int | None:
    """The ``seed`` of an ``independent`` sampler of Mitsuba; None for another kind, or for one that draws in another
    way."""
    import drjit as dr

    found = re.search(r"base_seed = (\d+)", str(sampler))
    if sampler.class_name() != "IndependentSampler" or not found:
        return None
    base, theirs, count = int(found[1]), sampler.clone(), 64
    theirs.seed(7, count)
    ours = for_samples(1, base, 7, 0, count)
    # Another release of Mitsuba may seed differently: its pictures are then rendered in one piece, and stay what they
    # are.
    return base if dr.all(theirs.next_2d() == ours.next_2d(), axis=None) else None


def for_samples(spp: int, base: int, seed: int, first: int, count: int):
    """A sampler for the samples ``first``, ..., ``first + count - 1`` of a picture with ``spp`` samples a pixel, which
    are counted pixel by pixel. ``base`` is the sampler's own seed and ``seed`` that of the render.

    Mitsuba renders at most 2^32 samples at once; beyond that the sequences are those of other seeds.
    """
    import drjit as dr

    mi = variant_types()
    number = dr.opaque(mi.UInt64, first) + mi.UInt64(dr.arange(mi.UInt32, count))
    low = mi.UInt32(number & 0xFFFFFFFF)
    high = mi.UInt32(number >> 32)
    key = dr.opaque(mi.UInt32, (base + seed) & 0xFFFFFFFF) + high * 0x9E3779B9
    state, stream = mi.sample_tea_32(key, low)
    return _class(mi.variant())(spp, mi.PCG32(initstate=mi.UInt64(state), initseq=mi.UInt64(stream)))


@functools.cache
def _class(variant: str):
    # Mitsuba's classes belong to a variant.
    import mitsuba as mi

    class Samples(mi.Sampler):
        def __init__(self, spp, generator):
            super().__init__(mi.Properties())
            self.set_sample_count(spp)
            self.generator = generator

        def next_1d(self, active=True):
            return self.generator.next_float32(mi.Bool(active))

        def next_2d(self, active=True):
            x = self.next_1d(active)
            return mi.Point2f(x, self.next_1d(active))

        def clone(self):
            return Samples(self.sample_count(), type(self.generator)(self.generator))

        def to_string(self):
            return f"Samples[{self.sample_count()} a pixel, {variant}]"

    return Samples
