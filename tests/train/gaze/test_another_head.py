"""A new kind of gaze field consists of two modules: all commands find it by its kind and its recipe."""

from __future__ import annotations

import importlib
from pathlib import Path

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

import nerg_mi.fields
import nerg_mi.train
from nerg_mi.fields import gaze_base
from nerg_mi.fields.gaze_base import GazeEnsemble
from nerg_mi.formats.fields import load_gaze, save_gaze
from nerg_mi.train import gaze_recipes
from nerg_mi.train.gaze import train_gaze
from tests.evaluation.test_gaze import crowd
from tests.plugins.scenes import camera, look_at, render

HEADS = Path(__file__).parents[2] / "heads"
OPTIONS = {"recipe": "place", "voxel_size": 0.3, "min_rays": 4, "seed": 1}


@pytest.fixture(scope="module")
def head():
    """The two modules as if they were in the packages, removed from the registries afterwards."""
    kinds, recipes = dict(gaze_base._KINDS), dict(gaze_recipes.RECIPES)
    for package in (nerg_mi.fields, nerg_mi.train):
        package.__path__.append(str(HEADS / package.__name__.rpartition(".")[2]))
    module = importlib.import_module("nerg_mi.fields.gaze_place")
    yield module
    for package in (nerg_mi.fields, nerg_mi.train):
        package.__path__.pop()
    for register, before in ((gaze_base._KINDS, kinds), (gaze_recipes.RECIPES, recipes)):
        register.clear()
        register.update(before)


@pytest.fixture(scope="module")
def trained(head, tmp_path_factory):
    return train_gaze(crowd(3000), "hits", **OPTIONS, output=tmp_path_factory.mktemp("head") / "gaze.safetensors")


def test_its_recipe_trains_and_folds_select_the_weight(head, trained):
    field, provenance = trained.network, trained.provenance
    assert isinstance(field, head.PlaceField) and provenance["recipe"] == "place" and provenance["steps"] == 12
    assert provenance["mix"]["folds"] == 2 and field.config.mix == provenance["mix"]["mix"] > 0
    untrained = head.PlaceField.random(field.config, field.box, ns, 1, field.prior.numpy()).parameters()
    moved = {k for k, v in field.parameters().items() if not np.allclose(v.numpy(), untrained[k].numpy())}
    assert moved == set(field.parameters()) - {"prior"}


def test_it_is_stored_rendered_and_a_torch_module(rgb, trained, tmp_path):
    path = tmp_path / "gaze.safetensors"
    save_gaze(trained.network, path, {})
    again, meta = load_gaze(path, ns)
    assert meta["architecture"]["kind"] == "place" and again.config == trained.network.config
    parts = {"gaze": {"type": "gazefield", "filename": str(path)}, "aovs": "gaze,emit,capture"}
    sensor = {**camera(rgb, size=8, fov=45), "to_world": look_at(rgb, (0, 0, 1.5), (1.5, 0, 1.2), (0, 0, 1))}
    ball = {"type": "sphere", "center": [1.5, 0, 1.2], "radius": 0.5}
    gaze = render(rgb, {"type": "nerg", **parts}, sensor, ball=ball)[..., 3]
    assert np.isfinite(gaze).all() and gaze[3:5, 3:5].min() > 0
    torch = pytest.importorskip("torch")
    from nerg_mi.fields.torch_modules import GazeModule

    # The networks have influence, whatever the folds select.
    again.set_prior(0.1)
    module, rng, box = GazeModule(again), np.random.default_rng(0), again.box
    p_od, p_o, r_o = (rng.uniform(box.lower, box.upper, size=(20, 3)).astype(np.float32) for _ in range(3))
    r_o /= np.linalg.norm(r_o, axis=1, keepdims=True)
    result = module(*map(torch.from_numpy, (p_od, p_o, r_o)), 2.0)
    arrays = [ns.Array3f(np.ascontiguousarray(v.T)) for v in (p_od, p_o, r_o)]
    np.testing.assert_allclose(result.detach().numpy(), again.evaluate(*arrays, integral=2.0)[0].numpy(), rtol=1e-5)
    result.sum().backward()
    assert module.get_parameter("emit_net__0").grad.abs().max() > 0
    assert not module.get_parameter("prior").requires_grad


def test_members_of_an_ensemble_are_of_its_kind(head, trained, tmp_path):
    field = trained.network
    both = GazeEnsemble([field, head.PlaceField.random(field.config, field.box, ns, 2, field.prior.numpy())])
    save_gaze(both, tmp_path / "both.safetensors", {})
    again = load_gaze(tmp_path / "both.safetensors", ns)[0]
    for member in again.members:
        # The networks have influence, whatever the folds select.
        member.set_prior(0.1)
    point, along = ns.Array3f(0.5, 0.1, 1.0), dr.normalize(ns.Array3f(1, 0.2, -0.1))
    densities = [m.evaluate(point, point, along, integral=1.0)[0].numpy() for m in again.members]
    assert len(densities) == 2 and all(isinstance(m, head.PlaceField) for m in again.members)
    assert not np.allclose(*densities)
