"""The protocol of encodings: what a user-defined encoding needs to be trained, stored and rendered."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.encoding import config_from_dict, register
from nerg_mi.fields.gaze_log_density import LogGazeConfig, LogGazeField
from nerg_mi.fields.gaze_product import GazeConfig, GazeField
from nerg_mi.fields.radiance import RadianceConfig, RadianceField
from nerg_mi.formats.fields import load_gaze, load_radiance, save_gaze, save_radiance
from nerg_mi.train.gaze_log_density import evaluate_log_density
from nerg_mi.train.gaze_product import evaluate_gaze_density
from nerg_mi.train.radiance_trainer import RadianceTrainer
from tests.fields.encoding.dense import DenseConfig, DenseGrid
from tests.plugins.scenes import camera, look_at
from tests.tiny import ball_pose
from tests.train.radiance.ball import BOX, ball, settings

register(DenseConfig, DenseGrid)
CONFIG = RadianceConfig(DenseConfig(), width=16, color_hidden=1, density_scale=0.5)
POINTS = np.random.default_rng(0).uniform(-0.9, 0.9, (3, 20)).astype(np.float32)
DIRECTIONS = np.tile(np.float32([[0.6], [0], [0.8]]), 20)


@pytest.fixture(scope="module")
def trained():
    """A radiance field with a dense grid after 40 steps, and the first and the last loss."""
    views = [ball(ball_pose(np.array(c))) for c in ([2.0, 0, 0.4], [-1.2, 1.6, 0], [-1.2, -1.6, 0.4])]
    trainer, losses = RadianceTrainer(views, BOX, CONFIG, settings(steps=40, batch=2**10), ns), []
    for _ in range(40):
        trainer.step()
        losses.append(float(trainer.loss[0]))
    return trainer.make_field(), losses


def test_dense_grid_trains(trained):
    field, losses = trained
    assert np.mean(losses[-5:]) < 0.6 * np.mean(losses[:5])
    untrained = RadianceField.random(CONFIG, BOX, ns, 1).parameters()["grid.values"].numpy()
    assert np.abs(field.parameters()["grid.values"].numpy() - untrained).max() > 0.01


def test_dense_grid_is_stored_under_its_kind(trained, tmp_path):
    field, _ = trained
    save_radiance(field, tmp_path / "dense.safetensors", {})
    again, meta = load_radiance(tmp_path / "dense.safetensors", ns)
    assert meta["architecture"]["grid"] == {"kind": "dense_of_the_tests", "finest": 8, "size": 4}
    assert again.config == CONFIG
    p = ns.Array3f(POINTS)
    assert np.array_equal(again.density(p).numpy(), field.density(p).numpy())


def test_dense_grid_renders_with_derivatives(rgb, trained, tmp_path):
    save_radiance(trained[0], tmp_path / "dense.safetensors", {})
    integrator = {"type": "nerg", "field": {"type": "nerf", "filename": str(tmp_path / "dense.safetensors")}}
    sensor = {**camera(rgb, size=16, fov=50), "to_world": look_at(rgb, (2, 0, 0.4), up=(0, 0, 1))}
    scene = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor})
    params = rgb.traverse(scene)
    name = next(k for k in params.keys() if k.endswith("grid.values"))
    dr.enable_grad(params[name])
    params.update()
    picture = rgb.render(scene, params, spp=1)
    color = picture.numpy()[..., :3]
    assert color[8, 8].min() > 0.02 and color[8, 8].mean() > 3 * color[0, 0].mean()
    dr.backward(dr.mean(picture))
    assert np.abs(dr.grad(params[name]).numpy()).max() > 0
    assert "grid = 4 x 8^3" in str(scene.integrator())


@pytest.mark.parametrize("kind", ["product", "log"])
def test_gaze_fields_with_dense_grid_are_stored_and_match_their_tensor_form(tmp_path, kind):
    field = (
        GazeField.random(GazeConfig(DenseConfig(), width=16, geometry=7, sh_degree=2), BOX, ns)
        if kind == "product"
        else LogGazeField.random(LogGazeConfig(DenseConfig(), width=16, layers=1, sh_degree=2, prior=4), BOX, ns)
    )
    save_gaze(field, tmp_path / "gaze.safetensors", {})
    again, _ = load_gaze(tmp_path / "gaze.safetensors", ns)
    assert again.config == field.config
    p_od, r_o = ns.Array3f(POINTS), ns.Array3f(DIRECTIONS)
    p_o, each = ns.Array3f(0.1, -0.2, 0.3), ns.Array3f(ns.Float([0.1] * 20), -0.2, 0.3)
    emit, capture = again.unnormalized(p_od, each, r_o)
    parameters = again.parameters()
    for v in parameters.values():
        dr.enable_grad(v)
    if kind == "product":
        fast = evaluate_gaze_density(again.config, BOX, parameters, p_od, p_o, r_o, ns)
    else:
        fast = dr.exp(
            evaluate_log_density(again.config, BOX, parameters, p_od, p_o, r_o, dr.full(ns.Bool, False, 20), ns)
        )
    assert np.allclose(fast.numpy(), (emit * capture).numpy(), rtol=1e-4)
    dr.backward(dr.sum(fast))
    assert np.abs(dr.grad(parameters["grid.values"]).numpy()).max() > 0


def test_dense_grid_as_torch_module(torch):
    from nerg_mi.interop.torch import RadianceModule

    field = RadianceField.random(CONFIG, BOX, ns, 3)
    module = RadianceModule(field)
    sigma, _ = module(torch.from_numpy(POINTS.T.copy()), torch.from_numpy(DIRECTIONS.T.copy()))
    assert np.allclose(sigma.detach().numpy(), field.density(ns.Array3f(POINTS)).numpy(), rtol=1e-4)
    sigma.sum().backward()
    assert module.get_parameter("grid__values").grad.abs().max() > 0


def test_dense_grid_has_its_own_size_limits(tmp_path):
    save_radiance(RadianceField.random(RadianceConfig(DenseConfig(size=17), width=16), BOX, ns), tmp_path / "f", {})
    with pytest.raises(ValueError, match='"size".*1.*16.*17'):
        load_radiance(tmp_path / "f", ns)


def test_protocol_default_methods():
    grid = DenseGrid.random(DenseConfig(), ns, np.random.default_rng(0))
    (values,) = grid.named().values()
    assert grid.kernel_parameters()[0].index == values.array.index
    grid.replace("values", values * 2)
    p = ns.Array3f(0.5 + 0.5 * POINTS)
    features = grid.evaluate_eagerly(p)
    assert np.allclose(np.array(features), np.array(grid(p)))
    slopes = []
    for rows in (lambda: grid(p), lambda: grid.attach(features, p)):
        dr.enable_grad(grid.values)
        dr.backward(dr.sum(sum(rows())))
        slopes.append(dr.grad(grid.values).numpy())
        dr.disable_grad(grid.values)
    assert np.abs(slopes[0]).max() > 0 and np.allclose(*slopes, rtol=1e-5)
    grid.check_config(DenseConfig())
    with pytest.raises(ValueError, match="but its field needs"):
        grid.check_config(DenseConfig(size=5))
    assert config_from_dict(DenseConfig(size=5).to_dict()) == DenseConfig(size=5)
