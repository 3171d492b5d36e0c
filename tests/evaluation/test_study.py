"""Tests of `nerg_mi.evaluation.study`."""

from __future__ import annotations

import math
import re
from types import SimpleNamespace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.evaluation import study as study_paper
from nerg_mi.evaluation import study_scenes
from nerg_mi.evaluation.study import RESOLUTIONS, STEP_COUNTS, PaperMarch, count_traced_operations, list_rows
from nerg_mi.evaluation.study_subject import open_subject
from nerg_mi.fields.occupancy import OccupancyGrid
from nerg_mi.transport.medium import LocalRay
from tests.evaluation.subjects import make_subject
from tests.plugins import fields
from tests.plugins.scenes import camera
from tests.reference import march_numpy

# ---- Measure ----
#
# Measurements of a study and their progress messages.


def test_compilation_of_the_second_frame_is_not_timed(monkeypatch):
    subject, calls = open_subject("slab", "auto", 6, 4), []
    render = subject.render
    monkeypatch.setattr(study_paper, "time_render", lambda *args: calls.append("timed") or (1.0, 1.0))
    monkeypatch.setattr(subject, "render", lambda *args: calls.append("render") or render(*args))
    rows = [study_paper.StudyRow("depth only", "leave out", {"aovs": "depth,opacity", "radiance": False})]
    said = []
    study_paper.measure_rows(subject, rows, 2, on_step=said.append)
    assert said == ["depth only", "time of depth only"]
    # Renders of the truth's rays, the errors, the counts, and the compilation.
    assert calls == ["render"] * 4 + ["timed"] * 2


# ---- Counts of traced operations, on any machine ----


def test_operation_count_grows_with_work_but_not_lanes():
    x = lambda n: dr.arange(ns.Float, n)
    one, two = (count_traced_operations(lambda f=f: f(x(100))) for f in (dr.sin, lambda v: dr.sin(v) + dr.cos(v * v)))
    assert 0 < one < two
    assert count_traced_operations(lambda: dr.sin(x(100_000))) == one


def test_earlier_computations_are_not_counted():
    y = dr.sin(dr.arange(ns.Float, 100))
    dr.eval(y)
    assert count_traced_operations(lambda: y) == 0


# ---- The paper's marching: counts, images, and skipping of empty cells without loss ----


@pytest.fixture
def seen(rgb):
    """Map AOVs, radiance and steps to the subject and its channels with the march of the paper."""
    subject = open_subject("sphere", "auto", 24, 16)

    def render(aovs, radiance=True, **march):
        made, march = subject.make_integrator({"aovs": aovs, "radiance": radiance}), {"steps": 256} | march
        return subject.render_channels(
            study_paper.make_paper_integrator(made, subject.sensor, subject.tolerance, PaperMarch(**march)), 1, 1
        )

    render.subject = subject
    return render


def test_observer_evaluations_are_counted(seen):
    depth = seen("depth,opacity,density_evals")
    evaluated = seen("depth,opacity,visibility,density_evals")
    gazed = seen("depth,opacity,visibility,gaze,density_evals")
    surface = depth["opacity"] >= 0.5
    options = evaluated["density_evals"] - depth["density_evals"]
    assert surface.any() and not surface.all()
    assert (depth["density_evals"] >= 0).all() and (options[surface] >= 1).all() and (options[~surface] == 0).all()
    for name in ("density_evals", "visibility"):
        assert np.array_equal(evaluated[name], gazed[name])
    attended = gazed["visibility"] > 0
    assert attended.any() and (gazed["gaze"][attended] > 0).any() and (gazed["gaze"][~attended] == 0).all()


def test_the_picture_tends_to_the_true_one_and_is_black_without_radiance(seen):
    truth = seen.subject.get_truth(1, "expected", "depth")
    off = [np.abs(seen("depth,opacity", steps=n)["color"] - truth.color).mean() for n in (128, 2048)]
    assert truth.color.max() > 0.5 and off[1] < off[0] / 4 < 0.01
    dark = seen("depth,opacity", radiance=False, steps=128)
    assert (dark["color"] == 0).all() and dark["opacity"].max() > 0.9


def test_deferred_fields_evaluate_colour_once_per_ray(rgb, tmp_path):
    """The picture converges to that of ``nerg``."""
    fields.radiance(tmp_path / "f.safetensors", deferred=True)
    field = {"type": "nerf", "filename": str(tmp_path / "f.safetensors")}
    made = rgb.load_dict({"type": "nerg", "field": field, "aovs": "depth,opacity,color_evals", "step": 2e-3})
    scene = rgb.load_dict({"type": "scene", "sensor": camera(rgb, size=8)})
    truth = np.array(rgb.render(scene, integrator=made, spp=1, seed=0))
    off = []
    for steps in (64, 1024):
        paper = study_paper.make_paper_integrator(made, scene.sensors()[0], 0.01, PaperMarch(steps))
        seen = np.array(rgb.render(scene, integrator=paper, spp=1, seed=0))
        off.append(np.abs(seen - truth)[..., :3].mean())
        assert np.array_equal(seen[..., 5], seen[..., 4] > 0)
    assert truth[..., :3].max() > 0.2 and off[1] < off[0] / 4 < 0.01


def test_corrections_of_the_papers_depth():
    """In a slab, whose steps absorb as much as its closed form, both together leave an error of second order."""
    subject = open_subject("slab", "auto", 12, 8)
    truth, made = subject.get_truth(1, "expected", "depth"), subject.make_integrator()

    def error(**corrections):
        march = PaperMarch(256, **corrections)
        integrator = study_paper.make_paper_integrator(made, subject.sensor, subject.tolerance, march)
        depth = subject.render_channels(integrator, 1, 1)["depth"]
        return np.abs(depth - truth.depth)[truth.opacity > 0.1].mean()

    middle, opacity = {"depth_at": 0.5}, {"divides_by_opacity": True}
    assert error(**middle, **opacity) < 0.3 * min(error(), error(**middle), error(**opacity))


@pytest.mark.parametrize("dt_gamma", [0.0, 0.05])
def test_skipping_empty_cells_changes_nothing(dt_gamma):
    """With constant steps, the same samples are taken behind an empty cell as without skipping, and none in it."""
    rng = np.random.default_rng(3)
    grid = OccupancyGrid(rng.random((5, 4, 6)) < 0.4, ns, 0)

    def density(p, active):
        full = grid.distance_to_occupied(p) == 0
        return dr.select(full, 2 + 3 * p.x + p.z, 0)

    count, step = 200, 1 / 300
    o = np.stack([rng.random(count), rng.random(count), np.full(count, -0.5)])
    d = np.stack([rng.random(count), rng.random(count), np.full(count, 1.2)]) - o
    d /= np.linalg.norm(d, axis=0)
    t0, t1 = (ns.Float(np.asarray(a / d[2], np.float32)) for a in (0.5, 1.5))
    origin, direction = (ns.Array3f(v.astype(np.float32)) for v in (o, d))
    ray = LocalRay(origin, direction, direction, t0, t1)
    result = []
    # The coarse grid of a refined grid.
    for occupancy in (grid, SimpleNamespace(coarse=grid), None):
        medium = SimpleNamespace(occupancy=occupancy, to_unit=lambda p: p, vector_to_unit=lambda v: v, density=density)
        medium.length_scale = 600 * step
        march = PaperMarch(600, dt_gamma)
        alpha, depth, _, n = study_paper.march_as_in_paper(medium, ray, t0, t1, True, None, march)
        result.append([np.array(v, float) for v in (alpha, depth, n)])
    leaping, refining, complete = result
    assert all(np.array_equal(a, b) for a, b in zip(leaping, refining))
    assert (leaping[2] <= complete[2]).all() and leaping[2].mean() < 0.6 * complete[2].mean()
    # A sample at a cell wall may be on either side by rounding; growing steps start elsewhere behind a skipped cell.
    bound = 0.04 if dt_gamma else 0.01
    assert complete[0].max() > 0.5 and np.abs(leaping[0] - complete[0]).max() < bound
    assert np.abs(leaping[1] - complete[1]).max() < 2 * bound
    if not dt_gamma:
        assert np.median(np.abs(leaping[0] - complete[0])) < 1e-5
        # The samples in occupied cells of the unit cube.
        t = 0.5 / d[2] + step * np.arange(600)[:, None]
        p = o[:, None] + d[:, None] * t
        cell = np.floor(p * np.array([6, 4, 5])[:, None, None]).astype(int)
        inside = (p[2] < 1) & (p[2] >= 0)
        full = grid.bits[np.clip(cell[2], 0, 4), np.clip(cell[1], 0, 3), np.clip(cell[0], 0, 5)] & inside
        assert np.abs(leaping[2] - full.sum(0)).max() <= 3 and np.median(np.abs(leaping[2] - full.sum(0))) == 0


def test_the_papers_depth_is_unnormalised_and_at_the_steps_end():
    subject = open_subject("slab", "auto", 12, 8)
    o, d = subject.record_rays(1)
    steps = 64
    step = subject.extent / steps
    seen = subject.render_channels(
        study_paper.make_paper_integrator(
            subject.make_integrator(), subject.sensor, subject.tolerance, PaperMarch(steps)
        ),
        1,
        1,
    )
    for i in range(0, len(o), 7):
        hit = march_numpy.box(o[i], d[i], (0, 0, 0), (1, 1, 1))
        depth, T = 0.0, 1.0
        if hit is not None:
            t = hit[0]
            while t < hit[1]:
                w = T * -math.expm1(-study_scenes.SLAB_DENSITY * step)
                t += step
                depth, last = depth + w * t, T < study_paper.PAPER_STOP
                T -= w
                if last:
                    break
        assert abs(seen["depth"][i] - depth) < 2e-2 * step + 0.04 * (1 - seen["opacity"][i])
        assert abs(seen["opacity"][i] - (1 - T)) < 2e-2
    half = (seen["opacity"] > 0.3) & (seen["opacity"] < 0.9)
    truth = subject.get_truth(1, "expected", "depth")
    assert half.any() and np.all(seen["depth"][half] < 0.95 * truth.depth[half])


# ---- The rows of a study: sweeps with even steps on log axes, and settings that match the names of rows ----


@pytest.fixture(scope="module")
def rows():
    return list_rows(make_subject(2.0, is_normalized=True, voxel_resolutions=(256, 512)))


def test_sweeps_are_even_on_a_log_axis(rows):
    steps = lambda group: [2.0 / r.params["step"] for r in rows if r.group == group]
    sweeps = {
        "steps": steps("steps, linear"),
        "resolutions": [r.resolution for r in rows if re.fullmatch(r"grid \d+, cells", r.name)],
        "dt_gamma": [r.params["dt_gamma"] for r in rows if r.group == "dt_gamma"],
        "coarse": [r.params["coarse"] for r in rows if r.group == "coarse"],
        "steps at a grid": [2.0 / r.params["step"] for r in rows if re.fullmatch(r"grid 64, cells, \d+ steps", r.name)],
        "map heights": [r.params["map_height"] for r in rows if "map_height" in r.params and not r.is_first_frame],
        "tolerances": [r.params["integral_tolerance"] for r in rows if r.group == "integral"][1:],
        "samples": [r.spp for r in rows if r.group == "spp"],
    }
    for name, values in sweeps.items():
        ratios = np.divide(values[1:], values[:-1])
        assert len(values) >= 3 and np.allclose(ratios, ratios[0]) and ratios[0] in (2, 4), (name, values)
    assert tuple(sweeps["steps"]) == STEP_COUNTS and tuple(sweeps["resolutions"]) == RESOLUTIONS


def test_rows_match_their_names(rows):
    assert rows[0].name == "default" and not rows[0].params and len({r.name for r in rows}) == len(rows)
    for row in rows:
        assert row.is_first_frame == row.name.endswith("first frame"), row.name
        if result := re.search(r"(\d+) steps", row.name):
            n = row.paper[0] if row.paper else 2.0 / row.params["step"]
            assert n == int(result[1]), row.name
        if result := re.search(r"dt_gamma 1/(\d+)", row.name):
            gamma = row.paper[1] if row.paper else row.params["dt_gamma"]
            assert gamma == 1 / int(result[1]), row.name
        elif row.paper:
            assert row.paper[1] == 0, row.name
