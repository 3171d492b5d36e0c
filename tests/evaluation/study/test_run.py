"""The study: references against closed forms and brute force, the paper's rule, Pareto fronts, and a quick run."""

import csv
import json
import math

import numpy as np
import pytest

from nerg_mi.evaluation.study import paper as study_paper
from nerg_mi.evaluation.study import plots as study_plots
from nerg_mi.evaluation.study import reference as study_reference
from nerg_mi.evaluation.study import scenes as study_scenes
from nerg_mi.evaluation.study import tables as study_tables
from nerg_mi.evaluation.study.errors import errors
from nerg_mi.evaluation.study.measure import COLUMNS
from nerg_mi.evaluation.study.settings import STEP_COUNTS, settings
from nerg_mi.evaluation.study.subject import open_subject
from tests.reference import march_numpy

NAMES = list(study_scenes.SCENES)


def rays(scene, count=24, seed=0):
    """Float64 rays from the scene's camera towards points of the cube, and one that misses."""
    rng = np.random.default_rng(seed)
    o = np.broadcast_to(np.asarray(scene.camera, float), (count, 3))
    d = rng.uniform(0.05, 0.95, (count, 3)) - o
    d[-1] = (0, -1, 0)
    return o, d / np.linalg.norm(d, axis=-1, keepdims=True)


# ------------------------------------------------------------------------
#  References
# ------------------------------------------------------------------------


def test01_slab_is_the_closed_form():
    scene = study_scenes.SCENES["slab"]
    o, d = rays(scene)
    seen = study_reference.look(scene, o, d)
    for i in range(len(o) - 1):
        near, far = march_numpy.box(o[i], d[i], (0, 0, 0), (1, 1, 1))
        alpha, expected, median = march_numpy.slab(study_scenes.SLAB_DENSITY, near, far)
        assert np.allclose((seen.opacity[i], seen.expected[i], seen.median[i]), (alpha, expected, median), rtol=1e-12)
    assert seen.opacity[-1] == seen.expected[-1] == seen.median[-1] == 0


@pytest.mark.parametrize("name", NAMES)
def test02_references_are_the_limit_of_a_float64_march(name):
    scene = study_scenes.SCENES[name]
    o, d = rays(scene, 12)
    seen = study_reference.look(scene, o, d)
    color = seen.color(o, d)
    for i in range(len(o) - 1):
        near, far = march_numpy.box(o[i], d[i], (0, 0, 0), (1, 1, 1))
        jumps = scene.breaks(o[i : i + 1], d[i : i + 1])[0]
        # Steps end at the jumps of density, so that midpoints do not straddle them.
        borders = np.unique(np.concatenate([np.linspace(near, far, 20001), jumps[(jumps > near) & (jumps < far)]]))
        tau, expected, median, total, _ = march_numpy.march(
            lambda p: scene.density(*p.T, study_scenes.NUMPY) + 0 * p[:, 0], o[i], d[i], borders, study_scenes.color
        )
        assert math.isclose(seen.tau[i], tau, rel_tol=1e-6)
        assert math.isclose(seen.expected[i], expected, rel_tol=1e-6) and math.isclose(
            seen.median[i], median, rel_tol=1e-6
        )
        assert np.allclose(color[i], total, atol=2e-5)


def test03_a_look_that_ends_is_the_front_of_a_whole_one():
    for scene in study_scenes.SCENES.values():
        o, d = rays(scene, 8)
        seen = study_reference.look(scene, o, d)
        half = study_reference.look(scene, o, d, seen.median)
        assert np.allclose(half.opacity, seen.opacity / 2, rtol=1e-9)


def test03_solids_are_met_where_geometry_says():
    subject = open_subject("sphere", "auto", 24, 16)
    t, visible = subject.exact(1)
    o, d = subject.rays(1)
    hit = np.isfinite(t)
    center, radius = study_scenes.SPHERE_CENTER, study_scenes.SPHERE_RADIUS
    p = o[hit] + d[hit] * t[hit, None]
    normal = (p - center) / radius
    assert hit.any() and np.allclose(np.linalg.norm(normal, axis=-1), 1, atol=1e-6)
    # A convex body hides from an observer what faces away.
    towards = np.asarray(subject.analytic.observer) - p
    assert np.array_equal(visible[hit], (towards * normal).sum(-1) > 0) and 0 < visible[hit].mean() < 1
    assert not visible[~hit].any() and open_subject("fog", "auto", 4, 4).exact(1) is None


def test03_the_point_looked_for_lies_on_the_face_of_a_solid_for_each_kind_of_depth():
    # A lift beyond the face would show a strip beyond the terminator, one short of it would hide a strip before it.
    subject = open_subject("sphere", "auto", 96, 64)
    t, visible = subject.exact(1)
    o, d = subject.rays(1)
    seen = study_reference.look(subject.analytic, o, d)
    thick = np.isfinite(t) & (seen.tau > 12)
    for kind in ("expected", "median"):
        known = study_reference.truth(
            subject.analytic,
            None,
            o,
            d,
            depth=kind,
            visibility="transmittance",
            falloff=0.1,
            tolerance=1e-9,
            surface_opacity=0.5,
        )
        assert thick.sum() > 100 and np.array_equal(known.visibility[thick] > 0.999, visible[thick]), kind


@pytest.mark.parametrize("visibility", ["depth", "transmittance"])
def test03_what_is_no_surface_is_not_visible(visibility):
    scene = study_scenes.SCENES["ramp"]
    o, d = rays(scene, 64)
    known = study_reference.truth(
        scene, None, o, d, depth="expected", visibility=visibility, falloff=0.1, tolerance=1e-3, surface_opacity=0.9
    )
    thin = known.opacity < 0.9
    assert 5 < thin.sum() < 60 and (known.opacity[thin] > 0.1).any() and known.opacity[-1] == 0
    assert (known.visibility[thin] == 0).all() and (known.visibility[~thin] > 0).any() and (known.gaze == 0).all()


def test03_volumes_fill_the_unit_cube(rgb):
    for resolution in (0, 4):
        for name, volume in study_scenes.volumes(study_scenes.SCENES["slab"], resolution).items():
            box = volume.bbox()
            assert np.array_equal([box.min, box.max], [[0, 0, 0], [1, 1, 1]]), name


@pytest.mark.parametrize("x", [0, 1e-300, 1e-6, 9.9e-3, 1.01e-2, 1, 50, 1e9])
def test04_mean_share(x):
    value = study_reference.mean_share(np.array([x]))[0]
    if x < 1e-5:
        assert abs(value - 0.5) < 1e-6
    else:
        assert math.isclose(value, 1 / x - (1 / math.expm1(x) if x < 700 else 0), rel_tol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test05_integrator_agrees_with_the_reference(name):
    subject = open_subject(name, "auto", 12, 8)
    known = subject.truth(1, "expected", "depth")
    off = errors(
        subject.channels(subject.integrator({"depth": "expected", "step": subject.extent / 2048}), 1, 1), known
    )
    # Thin or hard matter is what steps of a finite length find late.
    bound = 1e-3 if subject.opaque else 2e-6
    assert off["depth_mae"] < bound and off["opacity_mae"] < bound and off["color_rmse"] < max(20 * bound, 1e-4)
    assert off["visibility_mae"] < 30 * bound and off["gaze_mae"] < 30 * bound


def test06_a_grid_tends_to_its_density():
    subject = open_subject("fog", "auto", 12, 8)
    known = subject.truth(1, "expected", "depth")
    off = [
        errors(
            subject.channels(subject.integrator({"quadrature": "cells", "depth": "expected"}, resolution=r), 1, 1),
            known,
        )["depth_mae"]
        for r in (8, 32)
    ]
    assert off[1] < off[0] / 6 < 1e-2


# ------------------------------------------------------------------------
#  The paper's marching
# ------------------------------------------------------------------------


def test07_the_papers_depth_is_unnormalised_and_at_the_steps_end():
    subject = open_subject("slab", "auto", 12, 8)
    o, d = subject.rays(1)
    steps = 64
    step = subject.extent / steps
    seen = subject.channels(
        study_paper.as_in_the_paper(subject.integrator(), subject.sensor, subject.tolerance, steps), 1, 1
    )
    for i in range(0, len(o), 7):
        hit = march_numpy.box(o[i], d[i], (0, 0, 0), (1, 1, 1))
        depth, T = 0.0, 1.0
        if hit is not None:
            t = hit[0]
            while t < hit[1]:
                w = T * -math.expm1(-study_scenes.SLAB_DENSITY * step)
                t += step
                depth, last = depth + w * t, T < study_paper.STOP
                T -= w
                if last:
                    break
        assert abs(seen["depth"][i] - depth) < 2e-2 * step + 0.04 * (1 - seen["opacity"][i])
        assert abs(seen["opacity"][i] - (1 - T)) < 2e-2
    half = (seen["opacity"] > 0.3) & (seen["opacity"] < 0.9)
    known = subject.truth(1, "expected", "depth")
    assert half.any() and np.all(seen["depth"][half] < 0.95 * known.depth[half])


# ------------------------------------------------------------------------
#  Rows, fronts, errors
# ------------------------------------------------------------------------


def test08_pareto():
    assert study_tables.pareto([(1, 5), (2, 3), (3, 4), (4, 1), (5, 1)]) == [True, True, False, True, False]
    assert study_tables.pareto([(1, 1), (1, 1), (1, 2)]) == [True, True, False]
    assert study_tables.pareto([]) == []
    rng = np.random.default_rng(0)
    points = [tuple(p) for p in rng.random((200, 2))]
    beaten = [any(q != p and q[0] <= p[0] and q[1] <= p[1] for q in points) for p in points]
    assert study_tables.pareto(points) == [not b for b in beaten]


def test08b_against_paper_takes_the_best_of_either_kind():
    def row(setting, group, seconds, depth_mae):
        return {
            "setting": setting,
            "group": group,
            "seconds": seconds,
            "cpu_seconds": 2 * seconds,
            "depth_mae": depth_mae,
            "density_evals": 1.0,
            "spp": 1,
            "resolution": "",
            "visibility": "depth",
        }

    rows = [
        row("default", "default", 3, 0.1),
        row("short", "steps", 1, 0.4),
        row("map", "visibility", 0.1, 0.1) | {"visibility": "map"},
        row("slow", "steps", 9, 0.01),
        row("p", "paper", 4, 0.5),
        row("fast", "paper", 0.5, 0.001),
    ]
    for clock in ("seconds", "cpu_seconds"):
        first, second = study_tables.against_paper(rows, clock)
        assert first["equal_time"]["setting"] == "default" and math.isclose(first["equal_time"]["error_ratio"], 5)
        assert first["equal_error"]["setting"] == "short" and math.isclose(first["equal_error"]["time_ratio"], 4)
        assert second["equal_time"] is None and second["equal_error"] is None


def test09_exponent():
    x = np.array([1.0, 2, 8, 64])
    assert math.isclose(study_plots.exponent(x, 3 * x**1.5), 1.5)


def test10_settings_vary_one_factor_at_a_time():
    subject = open_subject("slab", "auto", 12, 8)
    rows = settings(subject)
    assert rows[0].name == "default" and not rows[0].params
    names = [r.name for r in rows]
    assert len(set(names)) == len(names)
    for rule in ("constant", "linear"):
        assert {r.params["step"] for r in rows if r.group == f"steps, {rule}"} == {
            subject.extent / n for n in STEP_COUNTS
        }
    groups = {r.group for r in rows}
    assert groups >= {
        "dt_gamma",
        "coarse",
        "stop",
        "color_cutoff",
        "depth",
        "visibility",
        "jitter",
        "leave out",
        "spp",
        "resolution",
        "paper",
    }


def test10b_a_quick_study_is_a_part_of_a_whole_one():
    subject = open_subject("slab", "auto", 12, 8)
    whole = {r.name for r in settings(subject)}
    quick = [r for r in settings(subject, quick=True) if r.group not in ("visibility", "spp", "paper")]
    assert len(quick) > 15 and {r.name for r in quick} <= whole


def test11_errors_of_known_pictures():
    n = 1000
    one, none = np.ones(n), np.zeros(n)
    known = study_reference.Truth(np.full((n, 3), 0.5), one, 2 * one, one, np.linspace(1, 2, n), "", {})
    seen = {
        "color": np.full((n, 3), 0.6),
        "opacity": one,
        "depth": np.where(np.arange(n) < 100, 2.5, 2.0),
        "visibility": one,
        "gaze": np.linspace(1, 2, n),
    }
    off = errors(seen, known, (2 * one, np.arange(n) >= 250))
    assert math.isclose(off["color_rmse"], 0.1, rel_tol=1e-9) and math.isclose(off["color_psnr"], 20, rel_tol=1e-9)
    assert math.isclose(off["depth_mae"], 0.05) and off["depth_p99"] == 0.5
    assert off["visibility_mae"] == 0 and off["visibility_wrong"] == 0.25
    assert off["gaze_mae"] == 0 and abs(off["gaze_kld"]) < 1e-12
    # A ray that met nothing counts in full; what was not rendered has no error.
    off = errors({"depth": none, "color": none[:, None]}, known)
    assert off["depth_mae"] == 2 and "color_rmse" not in off and "gaze_mae" not in off


# ------------------------------------------------------------------------
#  The command
# ------------------------------------------------------------------------


def test12_quick_run_of_the_command(tmp_path, capsys):
    import nerg_mi.cli

    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main(
            [
                "study",
                "slab",
                "--out",
                str(tmp_path / "new"),
                "--quick",
                "--width",
                "24",
                "--height",
                "16",
                "-m",
                "llvm_ad_rgb",
            ]
        )
    assert not end.value.code
    said = capsys.readouterr().out
    out = tmp_path / "new"
    for name in ("study.csv", "study.md", "scaling.csv", "study.json", "errors.png", "scaling.png"):
        assert (out / name).is_file() and str(out / name) in said.replace("\n", "")
    with (out / "study.csv").open() as f:
        rows = list(csv.DictReader(f))
    assert tuple(rows[0]) == COLUMNS
    required = "setting,seconds,density_evals,color_evals,gaze_evals,color_rmse,color_psnr,depth_mae,depth_p99,visibility_mae,gaze_mae,gaze_kld,peak_mb,pareto"
    assert set(required.split(",")) <= set(COLUMNS)
    by_name = {r["setting"]: r for r in rows}
    default = by_name["default"]
    assert float(default["seconds"]) > 0 and float(default["density_evals"]) > 100 and float(default["peak_mb"]) > 0
    assert float(default["depth_mae"]) < 1e-5
    # Evaluations that are not needed are not made.
    assert float(by_name["no colour"]["color_evals"]) == 0 and by_name["no colour"]["color_rmse"] == ""
    assert float(by_name["no observer"]["density_evals"]) < 0.8 * float(default["density_evals"])
    assert any("depth" in r["pareto"] for r in rows)
    report = json.loads((out / "study.json").read_text())
    assert report["scene"] == "slab" and len(report["rows"]) == len(rows) and report["against_paper"]
    assert {r["axis"] for r in report["scaling"]} == {"pixels", "samples", "extent"}
    paper = next(p for p in report["against_paper"] if p["paper"]["setting"] == "paper, 1024 steps")
    assert paper["paper"]["depth_mae"] > 1000 * paper["default"]["depth_mae"]


def test12b_only_some_settings(tmp_path):
    from nerg_mi.evaluation.study.run import run_study

    told = []
    report = run_study(
        "slab",
        tmp_path,
        width=12,
        height=8,
        quick=True,
        only="jitter|paper, 1024 steps$",
        variant="llvm_ad_rgb",
        on_step=lambda name, share: told.append((name, share)),
    ).report
    assert [r["setting"] for r in report["rows"]] == ["default", "jitter", "paper, 1024 steps"]
    # Of the share done the first renders have as much as the times, and the cost against size the rest.
    shares = [share for _, share in told]
    assert shares == sorted(shares) and shares[0] == 0 and shares[-1] < 1
    assert 0.4 < dict(told)["time of default"] < 0.5 and 0.8 < dict(told)["pixels 16"] < 1


@pytest.mark.parametrize(
    "arguments, said",
    [
        (["nowhere"], 'no scene file "nowhere"'),
        (["nowhere", "--scene-kind", "analytic"], "choose one of slab, sphere"),
        (["slab", "--scene-kind", "shapes"], 'no kind of scene "shapes"'),
        (["slab", "--width", "2"], "at least 4 x 4 pixels"),
        (["slab", "--only", "nothing of it"], 'no setting matches "nothing of it"'),
        (["slab", "--only", "("], '"(" is no regular expression'),
    ],
)
def test13_one_sentence(tmp_path, capsys, arguments, said):
    import nerg_mi.cli

    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main(["study", *arguments, "--out", str(tmp_path / "new"), "-m", "llvm_ad_rgb"])
    assert end.value.code == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and said in lines[0]
    assert not (tmp_path / "new").exists()


def test14_a_scene_file_is_compared_with_its_own_limit(rgb, tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text("""<scene version="3.0.0">
      <integrator type="nerg"><volume name="density" type="constvolume"><float name="value" value="4"/></volume></integrator>
      <sensor type="perspective"><float name="fov" value="30"/>
        <transform name="to_world"><lookat origin="0.5, 0.5, -2" target="0.5, 0.5, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="99"/><rfilter type="box"/><string name="component_format" value="float32"/></film>
      </sensor></scene>""")
    subject = open_subject(str(path), "auto", 12, 8)
    known = subject.truth(1, "median", "depth")
    assert known.depth.shape == (96,) and not subject.has_gaze and subject.exact(1) is None
    o, d = subject.rays(1)
    slab = study_scenes.SCENES["slab"]
    for i in range(0, 96, 13):
        hit = march_numpy.box(o[i], d[i], (0, 0, 0), (1, 1, 1))
        median = 0 if hit is None else march_numpy.slab(4.0, *hit)[2]
        assert abs(known.depth[i] - median) < 1e-5
    assert slab.name == "slab" and known.convergence["depth_mae"] < 1e-5
    bad = (
        path.read_text()
        .replace('<integrator type="nerg">', '<integrator type="path">')
        .replace("<volume", "<!--")
        .replace("</volume>", "-->")
    )
    path.write_text(bad)
    with pytest.raises(ValueError, match='is not "nerg"'):
        open_subject(str(path), "file", 12, 8)
