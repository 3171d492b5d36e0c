"""What a study measures and says meanwhile: one sample unless told, rounds over all rows, and the axes of the cost."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from nerg_mi.evaluation import study as study_measure
from nerg_mi.evaluation.study import Setting
from nerg_mi.evaluation.study_subject import open_subject


class Recorded:
    """A subject of step 0.5 that renders nothing and keeps what it was asked for."""

    size, step, marched, hits = (12, 8), 0.5, True, False

    def __init__(self):
        self.renders, self.steps = [], []

    def integrator(self, params=None, resolution=0):
        params = params or {}
        self.steps.append(params.get("step"))
        return SimpleNamespace(params=params)

    def resize(self, width, height):
        self.size = (width, height)

    def aovs(self):
        return "depth,opacity"

    def render(self, integrator, spp, seed):
        self.renders.append((self.size, spp, integrator.params.get("step")))

    def channels(self, integrator, spp, seed):
        return {n: np.full(4, 3.0) for n in study_measure.COUNTS}


def test_a_render_has_one_sample_a_pixel_unless_told():
    subject = Recorded()
    study_measure.timed(subject, subject.integrator())
    study_measure.timed(subject, subject.integrator(), 4)
    assert [spp for _, spp, _ in subject.renders] == [1, 4]


@pytest.mark.parametrize("quick", [True, False])
def test_cost_is_taken_along_doublings_from_the_scene_itself(quick):
    subject, said = Recorded(), []
    rows = study_measure.scaling(subject, 2, quick, said.append)
    of = lambda axis: [r["value"] for r in rows if r["axis"] == axis]
    assert len(said) == len(rows) and (len(rows) == 6) == quick
    for axis in ("samples", "extent"):
        assert of(axis) == [2**k for k in range(len(of(axis)))]
    sizes = [(k, 2 * k // 3) for k in (16 * 2**n for n in range(len(of("pixels"))))]
    assert of("pixels") == [width * height for width, height in sizes]
    assert list(dict.fromkeys(size for size, _, _ in subject.renders))[: len(sizes)] == sizes
    # An extent k times as large: steps k times shorter, in the picture that was asked for, with one sample.
    renders = [r for r in subject.renders if r[2] is not None]
    assert renders == [((12, 8), 1, 0.5 / k) for k in of("extent") for _ in range(3)]
    assert all(r["density_evals"] == 3.0 * (r["value"] if r["axis"] == "samples" else 1) for r in rows)


def test_every_row_is_announced_before_it_is_rendered_and_before_its_times():
    subject, said = open_subject("slab", "auto", 6, 4), []
    less = {"aovs": "depth,opacity", "radiance": False}
    rows = [Setting("default", "default"), Setting("depth only", "leave out", less)]
    study_measure.measure(subject, rows, 2, on_step=said.append)
    assert said == ["default", "depth only", "time of default", "time of depth only"]
