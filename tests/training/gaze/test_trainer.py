"""Gaze training: the fast path is the field, one probe is learnt, equal seeds agree, escapes, hit geometry, the
command."""

from __future__ import annotations

import json
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from nerg_mi.density.probes import place_probes
from nerg_mi.field.backend import namespace
from nerg_mi.field.encoding.hashgrid import HashGridConfig
from nerg_mi.field.gaze.product import GazeConfig, GazeField
from nerg_mi.formats.fields import load_gaze
from nerg_mi.formats.volumes import write_volume
from nerg_mi.maths.box import Box
from nerg_mi.maths.similarity import Similarity
from nerg_mi.rays.rays import Rays
from nerg_mi.training.gaze import run as gaze_run
from nerg_mi.training.gaze.product_model import gaze_density, used_parameters
from nerg_mi.training.gaze.settings import GazeSettings, ProbeSettings, sized_gaze_config
from nerg_mi.training.gaze.supervision import Supervision, box_exit, rotated_sets, supervise, supervise_rays
from nerg_mi.training.gaze.trainer import GazeTrainer, _Samples
from nerg_mi.training.geometry.hit_geometry import volume_dict, voxelise_hits
from nerg_mi.transport.media.volume import VolumeMedium

BOX = Box((-2, -2, 0), (2, 2, 3))
GRID = HashGridConfig(levels=2, log2_rows=10, base=4, finest=8)
SMALL = GazeConfig(grid=GRID, width=16, geometry=4)
PROBES = ProbeSettings(radius=0.5, count=16, cap=64, min_rays=8, kappa=20.0, directions=64)


def looking_at(target, n=400, seed=0, spread=1.2):
    """Rays of two people who walk about and look at ``target``, with hits on the wall x = 1.5."""
    rng = np.random.default_rng(seed)
    origin = np.stack([rng.uniform(-1.2, 0, n), rng.uniform(-spread, spread, n), rng.uniform(1.5, 1.7, n)], axis=1)
    direction = np.asarray(target) + rng.normal(0, 0.15, (n, 3)) - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    hit = origin + direction * ((1.5 - origin[:, :1]) / direction[:, :1])
    return Rays(np.arange(n), np.arange(n) % 2, ("a", "b"), origin, direction, np.ones(n), hit)


@pytest.fixture
def rays():
    return looking_at((1.5, 0.4, 1.2))


@pytest.fixture
def wall(rgb):
    """An opaque slab behind x = 1.5, in BOX."""
    data = np.zeros((6, 8, 8, 1), np.float32)
    data[:, :, 7] = 200
    to_world = rgb.ScalarTransform4f().translate([-2, -2, 0]).scale([4, 4, 3])
    volume = {"type": "gridvolume", "data": rgb.TensorXf(data), "filter_type": "nearest", "to_world": to_world}
    return VolumeMedium(rgb.load_dict(volume))


@pytest.fixture
def drawn():
    """Three probes of four directions, the first of the whole sphere, the others of parts of it; and that on the
    device."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(3, 4, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    positions, truth, distance = rng.uniform(-1, 1, (3, 3)), rng.random((3, 4)), rng.uniform(1, 2, (3, 4))
    extent = np.array([4 * np.pi, 1.5, 0.5], np.float32)
    data = Supervision(positions, directions, truth, distance, np.zeros((3, 4), bool), extent=extent)
    return data, _Samples(data, namespace("llvm"))


def test_directions_of_a_batch_are_those_of_its_probes(drawn):
    data, samples = drawn
    probe, which = np.array([2, 0, 2]), np.array([[3, 1], [0, 0], [1, 2]])
    p_od, p_o, r_o, index = samples.gather(probe, which)
    towards, distance = data.directions[probe[:, None], which], data.distance[probe[:, None], which]
    np.testing.assert_allclose(p_o.numpy().T, data.positions[probe], rtol=1e-6)
    np.testing.assert_allclose(r_o.numpy().T, towards.reshape(-1, 3), rtol=1e-6)
    ends = data.positions[probe][:, None] + towards * distance[..., None]
    np.testing.assert_allclose(p_od.numpy().T, ends.reshape(-1, 3), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(samples.truth(index).numpy(), data.truth[probe[:, None], which].ravel(), rtol=1e-6)


@pytest.mark.parametrize("known", [False, True])
def test_only_views_are_given_what_they_show(drawn, known):
    """A part of the sphere has the truth's integral, or one; the whole sphere and what is zero stay as they are."""
    data, samples = drawn
    density = np.array([[1.0, 2, 3, 4], [0, 1, 0, 2], [0, 0, 0, 0]])
    flat = lambda v: samples.ns.Float(v.ravel().astype(np.float32))
    got = samples.given_view(flat(density), np.arange(3), flat(data.truth) if known else None).numpy().reshape(3, 4)
    goal = data.truth[1].mean() * 1.5 if known else 1.0
    np.testing.assert_allclose(got, [density[0], density[1] * goal / (0.75 * 1.5), density[2]], rtol=1e-5)


@pytest.mark.parametrize("variant", ["emit", "capture", "emit_capture"])
@pytest.mark.parametrize("activation", ["softplus", "linear"])
def test_the_fast_path_is_the_field(variant, activation):
    ns, rng = namespace("llvm"), np.random.default_rng(3)
    field = GazeField.random(replace(SMALL, variant=variant, activation=activation, emit_scale=0.3), BOX, ns, 5)
    # Random tables are near zero: features of size one show an index that is wrong.
    field.set_parameters({"grid.table": ns.Float(rng.normal(size=len(field.grid.table)).astype(np.float32))})
    B, D = 3, 7
    p_o, p_od = rng.uniform(0, 1.9, (3, B)), rng.uniform(-0.5, 2.5, (3, B * D))
    r_o = rng.normal(size=(3, B * D))
    r_o /= np.linalg.norm(r_o, axis=0)
    p_o, p_od, r_o = (ns.Array3f(np.ascontiguousarray(v, np.float32)) for v in (p_o, p_od, r_o))
    fast = gaze_density(field.config, BOX, field.parameters(), p_od, p_o, r_o, ns)
    each = dr.gather(ns.Array3f, p_o, dr.arange(ns.UInt32, B * D) // D)
    np.testing.assert_allclose(np.array(fast), np.array(field.evaluate(p_od, each, r_o)[0]), rtol=2e-5, atol=1e-6)


@pytest.mark.parametrize("variant", ["emit", "capture", "emit_capture"])
def test_gradients_reach_what_the_variant_uses(variant):
    ns = namespace("llvm")
    config = replace(SMALL, variant=variant)
    parameters = used_parameters(config, GazeField.random(config, BOX, ns, 5).parameters())
    dr.enable_grad(parameters)
    p_o, r_o = ns.Array3f([0.1], [0.2], [1.0]), ns.Array3f([0, 0.6], [0.8, 0], [0.6, 0.8])
    dr.backward(dr.sum(gaze_density(config, BOX, parameters, ns.Array3f([0.1, 1], [1, 0.2], [2, 2]), p_o, r_o, ns)))
    for name, value in parameters.items():
        assert np.any(np.array(dr.grad(value)) != 0), name


def test_one_probe_is_learnt(rays, wall):
    probes = place_probes(rays, 0.5, queries=[[-0.6, 0, 1.6]], min_rays=8, kappa_rule="fixed", kappa=20.0)
    supervision = supervise(probes, wall, BOX, 256)
    np.testing.assert_allclose(4 * np.pi * supervision.truth.mean(), 1, atol=0.01)
    settings = GazeSettings(steps=200, learning_rate=1e-2, weight_decay=0.0, zones=0)
    trainer = GazeTrainer(supervision, BOX, SMALL, settings, namespace("llvm"))
    before = trainer.measure(supervision)
    for _ in range(200):
        trainer.step()
    after = trainer.measure(supervision)
    assert before.kld > 0.5
    assert after.kld < 0.05 and after.cc > 0.97 and abs(after.integral - 1) < 0.15


@pytest.mark.parametrize("average", [0.0, 0.3, 0.999])
def test_what_is_kept_is_the_average_of_the_weights_so_far(rays, wall, average):
    """An exponential one, whose memory is short at first: of (k + 1) in (k + 10) after k steps, of ``average``
    later."""
    probes = place_probes(rays, 0.5, queries=[[-0.6, 0, 1.6]], min_rays=8, kappa_rule="fixed", kappa=20.0)
    settings = GazeSettings(steps=5, learning_rate=1e-2, zones=0, average=average)
    trainer = GazeTrainer(supervise(probes, wall, BOX, 64), BOX, SMALL, settings, namespace("llvm"))
    expected = {k: v.numpy().astype(float) for k, v in trainer.optimiser.items()}
    for k in range(1, 6):
        trainer.step()
        memory = min(average, (k + 1) / (k + 10))
        for name, value in trainer.optimiser.items():
            expected[name] = memory * expected[name] + (1 - memory) * value.numpy()
    for name, value in trainer.weights().items():
        np.testing.assert_allclose(value.numpy(), expected[name], atol=1e-6)
    assert average == 0 or np.abs(expected["emit_head.0"] - trainer.optimiser["emit_head.0"].numpy()).max() > 1e-4


def test_equal_seeds_train_equal_fields(rays, wall):
    settings = GazeSettings(steps=6, zones=0, probes=2, directions=32, refit=False)
    train = lambda s: gaze_run.train_gaze(rays, wall, BOX, SMALL, s, PROBES, namespace("llvm"))[0].parameters()
    first, second, other = train(settings), train(settings), train(replace(settings, seed=1))
    for name in first:
        np.testing.assert_allclose(np.array(first[name]), np.array(second[name]), atol=1e-6)
    assert np.abs(np.array(first["emit_head.0"]) - np.array(other["emit_head.0"])).max() > 1e-3


def test_directions_that_meet_nothing_end_where_the_box_ends(rays, wall):
    supervision = supervise_rays(rays, wall, BOX, PROBES)
    p = supervision.positions[:, None] + supervision.directions * supervision.distance[..., None]
    # The wall is met from x = 1.5 on, everything else ends on the box.
    assert np.abs(p[~supervision.escaped][:, 0] - 1.5).max() < 0.02
    lower, upper = np.array(BOX.lower), np.array(BOX.upper)
    on_box = np.minimum(np.abs(p - lower), np.abs(p - upper)).min(axis=-1)
    assert on_box[supervision.escaped].max() < 1e-5
    assert 0.5 < supervision.escape_share < 0.95
    # They look at the wall: what escapes is the tail of the kernels.
    assert supervision.escaped_gaze < 0.1


def test_exits_of_a_box():
    o = np.array([[0, 0, 1.0], [0, 0, 1], [5, 0, 1], [5, 0, 1], [0, 2, 1]])
    d = np.array([[1.0, 0, 0], [0, 0, -1], [-1, 0, 0], [1, 0, 0], [1, 0, 0]])
    np.testing.assert_allclose(box_exit(BOX, o, d), [2, 1, 7, BOX.diagonal, 2])


def test_sets_of_directions_are_turned_each_its_own_way():
    sets = rotated_sets(64, 3, np.random.default_rng(0))
    np.testing.assert_allclose(np.linalg.norm(sets, axis=-1), 1)
    np.testing.assert_allclose(
        sets @ sets.transpose(0, 2, 1), np.broadcast_to((sets @ sets.transpose(0, 2, 1))[0], (3, 64, 64)), atol=1e-12
    )
    assert np.abs(sets[0] - sets[1]).max() > 0.1


def test_rays_are_aligned_with_the_field(rays, wall):
    """Half the size, turned and moved: the same supervision, in the field's frame."""
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 2 * turn, (0.3, -0.4, 0.5)
    inverse = np.linalg.inv(matrix)
    moved = replace(
        rays, origin=rays.origin @ inverse[:3, :3].T + inverse[:3, 3], direction=rays.direction @ turn, hit=None
    )
    probes = lambda r, radius: place_probes(r, radius, count=8, min_rays=8, kappa_rule="fixed", seed=1)
    a = supervise(probes(rays, 0.5), wall, BOX, 32)
    b = supervise(probes(moved, 0.25), wall, BOX, 32, Similarity(matrix))
    np.testing.assert_allclose(b.positions, a.positions, atol=1e-5)
    back = b.directions @ turn
    np.testing.assert_allclose(back, a.directions, atol=1e-6)
    # The distances are those from the field's frame: traced again along the same rays.
    np.testing.assert_allclose(np.linalg.norm(b.directions, axis=-1), 1, atol=1e-6)
    inside = ~b.escaped
    p = b.positions[:, None] + b.directions * b.distance[..., None]
    assert inside.any() and np.abs(p[inside][:, 0] - 1.5).max() < 0.02


def test_held_out_positions_are_purged():
    rays = looking_at((1.5, 0, 1.2), 3000, spread=6.0)
    kept, account = gaze_run.hold_out(rays, 0.25, zones=2, positions=10, min_rays=8)
    centres = np.array(account["centres"])
    apart = np.linalg.norm(kept.origin[:, None] - centres[None], axis=2)
    assert apart.min() > 0.5 and len(kept) == account["rays_to_train"] < len(rays)
    assert json.loads(json.dumps(account)) == account


def test_validation_stops_and_the_best_is_fitted_again(rgb):
    rays = looking_at((1.5, 0, 1.2), 3000, spread=6.0)
    density, box = voxelise_hits(rays, 0.2)
    data = rgb.TensorXf(density[..., None])
    to_world = rgb.ScalarTransform4f().translate(box.lower).scale([float(u - l) for l, u in zip(box.lower, box.upper)])
    medium = VolumeMedium(rgb.load_dict({"type": "gridvolume", "data": data, "to_world": to_world}))
    settings = GazeSettings(steps=12, looks=4, zones=2, watched=6, probes=4, directions=32)
    states = []
    field, about = gaze_run.train_gaze(
        rays, medium, box, SMALL, settings, PROBES, namespace("llvm"), on_progress=states.append
    )
    v = about["validation"]
    assert v["best_step"] in [h["steps"] for h in v["history"]] and about["refitted"]
    assert about["steps"] == v["best_step"] and v["loss"] == min(h["loss"] for h in v["history"])
    assert {s.stage for s in states} == {"probes", "fit", "refit"} and states[-1].done == 1
    assert 0 < v["rays_held_out"] < len(rays) and json.loads(json.dumps(about, allow_nan=False)) == about
    assert field.config == SMALL


@pytest.mark.parametrize("patience, looks", [(3, 4), (1, 2), (0, 10)])
def test_a_run_ends_when_looking_has_been_in_vain_for_long_enough(wall, patience, looks):
    """Nothing is learnt at a rate of next to nothing: the first look is the best, and ``patience`` more are taken."""
    settings = GazeSettings(
        steps=20,
        looks=10,
        patience=patience,
        zones=2,
        watched=6,
        probes=4,
        directions=32,
        learning_rate=1e-30,
        refit=False,
    )
    _, about = gaze_run.train_gaze(
        looking_at((1.5, 0, 1.2), 3000, spread=6.0), wall, BOX, SMALL, settings, PROBES, namespace("llvm")
    )
    v = about["validation"]
    assert (
        [h["steps"] for h in v["history"]] == [2 * k for k in range(1, looks + 1)]
        and v["best_step"] == 2
        and about["steps"] == 2 * looks
    )


def test_a_place_made_of_hits(rgb, rays, tmp_path):
    density, box = voxelise_hits(rays, 0.1)
    assert density.dtype == np.float32 and (density > 0).any()
    write_volume(tmp_path / "place.vol", density, box.lower, box.upper)
    medium = VolumeMedium(rgb.load_dict(volume_dict(tmp_path / "place.vol")))
    np.testing.assert_allclose(medium.bounds(), [box.lower, box.upper], atol=1e-5)
    from nerg_mi.transport.trace import trace_depth

    central = np.abs(rays.hit - np.median(rays.hit, axis=0)).max(axis=1) < 0.1
    depth, opacity = trace_depth(medium, rays.origin[central], rays.direction[central])
    truth = np.linalg.norm(rays.hit - rays.origin, axis=1)[central]
    assert central.sum() > 5 and (opacity > 0.99).all() and np.abs(depth - truth).max() < 0.15


def test_a_place_needs_hits(rays):
    with pytest.raises(ValueError, match="--field"):
        voxelise_hits(replace(rays, hit=None))
    with pytest.raises(ValueError, match="enlarge the voxel"):
        voxelise_hits(rays, 1e-3)


@pytest.mark.parametrize("variant", ["emit", "emit_capture"])
@pytest.mark.parametrize("activation", ["softplus", "exp"])
def test_weights_of_zero_are_the_uniform_density(variant, activation):
    config = sized_gaze_config("small", variant, activation)
    field = GazeField.random(config, BOX, namespace("llvm"), 0)
    field.set_parameters({k: v * 0 for k, v in field.parameters().items()})
    ns = namespace("llvm")
    p, d = ns.Array3f(0.1, 0.2, 1.0), ns.Array3f(0.6, 0, 0.8)
    assert float(field.evaluate(p, p, d)[0][0]) == pytest.approx(1 / (4 * np.pi), rel=1e-5)
    with pytest.raises(ValueError, match="scale"):
        replace(config, emit_scale=0.0)


def test_settings_that_make_no_sense_are_refused():
    for wrong in (
        {},
        {"steps": 1, "minutes": 1.0},
        {"steps": 0},
        {"steps": 1, "loss": "mse"},
        {"steps": 1, "probes": 0},
    ):
        with pytest.raises(ValueError):
            GazeSettings(**wrong)
    with pytest.raises(ValueError, match="size"):
        sized_gaze_config("huge")
    assert sized_gaze_config("paper").grid == GazeConfig().grid


def test_the_command_trains_on_hits(rays, tmp_path, monkeypatch, capsys):
    import typer

    from nerg_mi.cli.train_gaze import train_gaze

    rays.save(tmp_path / "rays.npz")
    out = tmp_path / "out" / "gaze.safetensors"
    app = typer.Typer()
    app.command()(train_gaze)
    arguments = f"{tmp_path / 'rays.npz'} --geometry hits --voxel 0.2 -o {out} --radius 0.5 --probes 8 --min-rays 8 --steps 3 --directions 32 --zones 0 --half"
    app(arguments.split(), standalone_mode=False)
    said = capsys.readouterr().out
    assert "meet no surface" in said and out.with_suffix(".vol").exists()
    field, meta = load_gaze(out, namespace("llvm"))
    about = meta["provenance"]
    assert (
        about["steps"] == 3 and len(about["rays_file"]["sha256"]) == 64 and len(about["geometry_file"]["sha256"]) == 64
    )
    with pytest.raises(ValueError, match="one of --field FILE, --scene FILE"):
        app([str(tmp_path / "rays.npz"), "-o", str(out)], standalone_mode=False)
    with pytest.raises(ValueError, match="add --recipe small"):
        app([*arguments.split(), "--loss", "paper"], standalone_mode=False)


@pytest.mark.parametrize("recipe", ["default", "small", "paper"])
def test_recipes_in_a_scene_of_shapes(rgb, rays, tmp_path, recipe):
    """The wall as a shape: its exact distance, and what looks past it escapes."""
    import typer

    from nerg_mi.cli.train_gaze import train_gaze
    from nerg_mi.training.geometry.places import place_of_scene

    (tmp_path / "scene.xml").write_text("""<scene version="3.0.0"><shape type="rectangle"><transform name="to_world">
        <scale value="2"/><lookat origin="1.5, 0, 1.5" target="0, 0, 1.5" up="0, 0, 1"/></transform></shape></scene>""")
    rays.save(tmp_path / "rays.npz")
    app, out = typer.Typer(), tmp_path / "gaze.safetensors"
    app.command()(train_gaze)
    app(
        f"{tmp_path / 'rays.npz'} --scene {tmp_path / 'scene.xml'} --recipe {recipe} -o {out} --radius 0.5 --probes 6 --min-rays 8 "
        f"--steps 2 --directions 64 --zones 0 {'--size small' if recipe == 'paper' else ''}".split(),
        standalone_mode=False,
    )
    field, meta = load_gaze(out, namespace("llvm"))
    assert meta["provenance"]["recipe"] == recipe and 0.3 < meta["provenance"]["escaped_directions"] < 0.9
    assert meta["output"] == {
        "activation": {"default": "log", "small": "softplus", "paper": "linear"}[recipe],
        "normalized": recipe == "default",
    }
    place = place_of_scene(tmp_path / "scene.xml")
    data = supervise_rays(rays, place.medium, place.box, PROBES)
    hit = data.positions[:, None] + data.directions * data.distance[..., None]
    np.testing.assert_allclose(hit[~data.escaped][:, 0], 1.5, atol=1e-5)


def test_without_geometry(rays, tmp_path):
    import typer

    from nerg_mi.cli.train_gaze import train_gaze

    rays.save(tmp_path / "rays.npz")
    app, out = typer.Typer(), tmp_path / "gaze.safetensors"
    app.command()(train_gaze)
    arguments = (
        f"{tmp_path / 'rays.npz'} --geometry none -o {out} --radius 0.5 --probes 6 --steps 2 --directions 64 --zones 0"
    )
    app(arguments.split(), standalone_mode=False)
    field, meta = load_gaze(out, namespace("llvm"))
    assert (
        field.config.geometry == "none"
        and meta["provenance"]["geometry"] == "none"
        and meta["provenance"]["escaped_directions"] == 0
    )
    with pytest.raises(ValueError, match="needs surfaces"):
        app([*arguments.split(), "--recipe", "small"], standalone_mode=False)


def test_people_and_positions_are_held_out():
    rays = looking_at((1.5, 0, 1.2), 4000, spread=6.0)
    kept, account = gaze_run.hold_out(rays, 0.25, zones=2, positions=10, min_rays=8, people=0.5)
    assert len(account["people"]) == 1 and set(np.unique(kept.person)) == {1 - rays.persons.index(account["people"][0])}
    assert np.linalg.norm(kept.origin[:, None] - np.array(account["centres"])[None], axis=2).min() > 0.5
