"""The register of encodings: kinds in files, and what is no encoding."""

from dataclasses import dataclass

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.encoding import (
    HashGrid,
    HashGridConfig,
    config_type,
    encoding_config,
    encoding_of,
    random_encoding,
    register,
)

CONFIG = HashGridConfig(levels=2, log2_rows=6, base=2, finest=4)


def test_a_configuration_without_a_kind_is_a_hash_grid():
    assert encoding_config(CONFIG.to_dict()) == CONFIG and "kind" not in CONFIG.to_dict()
    assert encoding_config({"kind": "hashgrid", **CONFIG.to_dict()}) == CONFIG
    assert config_type({}) is HashGridConfig


@pytest.mark.parametrize("kind", ["permutohedral", 3, None, ["hashgrid"]])
def test_an_unknown_kind_is_named(kind):
    with pytest.raises(ValueError, match="version does not know"):
        encoding_config({"kind": kind})


def test_a_kind_has_one_encoding():
    @dataclass(frozen=True)
    class Other(HashGridConfig):
        pass

    with pytest.raises(ValueError, match='"hashgrid"'):
        register(Other, HashGrid)
    register(HashGridConfig, HashGrid)


def test_encodings_by_configuration():
    grid = random_encoding(CONFIG, ns, np.random.default_rng(1))
    same = HashGrid.random(CONFIG, ns, np.random.default_rng(1))
    assert np.array_equal(grid.table.numpy(), same.table.numpy())
    parameters = {"behind.table": grid.table, "grid.table": grid.table * 0}
    found = encoding_of(CONFIG, parameters, "behind", dr.ReduceMode.Expand)
    assert found.table is grid.table and found.mode == dr.ReduceMode.Expand
    assert not encoding_of(CONFIG, parameters).table.numpy().any()
