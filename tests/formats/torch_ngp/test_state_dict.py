"""State dictionaries: weights by name, below a prefix, averaged, and of sizes that are read off them."""

from pathlib import Path

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.torch_files import write_torch
from nerg_mi.formats.torch_ngp import (
    StateDict,
    decimals,
    grid_config,
    layers,
    open_checkpoint,
    origin,
    read_torch_ngp,
    sh_degree,
)
from tests.formats.torch_ngp.test_fields import save
from tests.reference import torch_ngp_numpy as reference

pytestmark = pytest.mark.usefixtures("torch")


@pytest.fixture
def state(tmp_path):
    """A checkpoint of a net below a prefix and one that has diverged, as a state dictionary."""
    path = tmp_path / "s.pth"
    tensors = {
        "model.net.0.weight": np.ones((3, 2), np.float32),
        "model.net.1.weight": np.full((1, 3), 2, np.float16),
        "model.far.0.weight": np.full((1, 2), np.inf, np.float32),
        "other": np.zeros(1, np.float32),
    }
    write_torch(path, {"model": tensors, "epoch": 3, "global_step": "many"})
    whole, model = open_checkpoint(path)
    return path, whole, StateDict(Path(path), model)


def test_names_below_a_prefix(state):
    _, _, tensors = state
    below = tensors.below("model.net.")
    assert below.names() == ["0.weight", "1.weight"] and "0.weight" in below and "other" not in below
    assert below.shape("0.weight") == (3, 2) and below["0.weight"].tolist() == [[1, 1]] * 3
    with pytest.raises(NergError, match='s.pth" lacks "model.net.2.weight"'):
        below.shape("2.weight")


def test_weights_are_finite_float32(state):
    _, _, tensors = state
    assert tensors.weights("model.net.1.weight").dtype == np.float32
    with pytest.raises(NergError, match='"model.far.0.weight".*diverged'):
        tensors.weights("model.far.0.weight")


def test_networks_have_the_layers_that_are_there(state):
    _, _, tensors = state
    net = layers(tensors.below("model."), "net", ns)
    assert [w.shape for w in net.weights] == [(3, 2), (1, 3)]


def test_where_a_field_comes_from(state):
    path, whole, _ = state
    assert origin(path, whole, "torch-ngp", True) == {
        "imported_from": "s.pth",
        "format": "torch-ngp",
        "weights": "moving averages",
        "epoch": 3,
    }


def test_what_is_no_checkpoint(tmp_path):
    write_torch(tmp_path / "x.pth", {"model": {"a": 1}})
    with pytest.raises(NergError, match="holds no weights"):
        open_checkpoint(tmp_path / "x.pth")
    write_torch(tmp_path / "l.pth", [1])
    with pytest.raises(NergError, match="holds a list, not a checkpoint"):
        open_checkpoint(tmp_path / "l.pth")


def test_numbers_that_were_typed(state):
    assert decimals(np.float32([2.7, -0.1])).tolist() == [2.7, -0.1]
    _, _, tensors = state
    assert sh_degree(tensors, 16) == 4
    for wrong in (15, 0, -1):
        with pytest.raises(NergError, match="not spherical harmonics"):
            sh_degree(tensors, wrong)


def test_a_grid_is_read_off_its_levels(tmp_path):
    where = reference.offsets(4, 512)
    tensors = {"e.embeddings": np.zeros((where[-1], 2), np.float32), "e.offsets": where}
    write_torch(tmp_path / "g.pth", {"model": tensors})
    grid = StateDict(tmp_path / "g.pth", open_checkpoint(tmp_path / "g.pth")[1])
    config = grid_config(grid, "e", 512.0)
    assert config.offsets() == where.tolist() and config.finest == 512 and isinstance(config.finest, int)
    with pytest.raises(NergError, match="16.*32.*--finest"):
        grid_config(grid, "e", 32)


def test_moving_averages(tmp_path, torch):
    # As torch itself writes it: with an optimiser, parameters, half-precision and numpy numbers in the statistics.
    state = reference.nerf_state(1, np.random.default_rng(7))
    weights = [k for k in state if k.endswith(("embeddings", "weight"))]
    shadow = [torch.tensor(state[k]) * 2 for k in weights]
    adam = torch.optim.Adam([torch.nn.Parameter(torch.ones(3))])
    adam.param_groups[0]["params"][0].sum().backward()
    adam.step()
    torch.save(
        {
            "epoch": 3,
            "global_step": 30,
            "stats": {"loss": [np.float64(0.5)], "best_result": None},
            "mean_count": 0,
            "model": {k: torch.tensor(v) for k, v in state.items()},
            "optimizer": adam.state_dict(),
            "ema": {"decay": 0.95, "num_updates": 3, "shadow_params": shadow, "collected_params": None},
        },
        tmp_path / "ngp_ep0003.pth",
    )
    for ema, factor, said in ((None, 2, "moving averages"), (True, 2, "moving averages"), (False, 1, "raw")):
        field, origin = read_torch_ngp(tmp_path / "ngp_ep0003.pth", ns, ema)
        assert np.array_equal(field.color_net.weights[2].numpy(), factor * state["color_net.2.weight"])
        assert np.array_equal(field.grid.table.numpy()[:100], factor * state["encoder.embeddings"].ravel()[:100])
        assert origin["weights"] == said and origin["global_step"] == 30
    with pytest.raises(ValueError, match="--no-ema"):
        read_torch_ngp(save(tmp_path / "raw.pth", state), ns, ema=True)
    bad = {"shadow_params": [np.zeros((2, 2), np.float32)]}
    with pytest.raises(ValueError, match="1 moving averages .* do not fit its 6 weights"):
        read_torch_ngp(save(tmp_path / "bad.pth", state, ema=bad), ns)
