"""Rays from what is named: a file, a dataset, or a place of one."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import file_sha256
from nerg_mi.rays.dataset import is_dataset
from nerg_mi.rays.dataset_open import load_rays, rays_digest

from .making import assert_same, write_dataset

pytest.importorskip("pyarrow")


def test_files_and_datasets(tmp_path):
    dataset, rays = write_dataset(tmp_path)
    rays.save(tmp_path / "rays.npz")
    for path in (tmp_path / "rays.npz", dataset.folder, dataset.folder / "place=shop"):
        assert_same(load_rays(path), rays)
        assert is_dataset(path) is (path.suffix != ".npz")
    assert rays_digest(tmp_path / "rays.npz") == file_sha256(tmp_path / "rays.npz")
    assert rays_digest(dataset.folder) == dataset.digest
    some = load_rays(dataset.folder, 100, seed=2)
    assert np.array_equal(some.t, dataset.sample(100, 2).t) and len(load_rays(dataset.folder, 5000)) == len(rays)
    assert len(load_rays(tmp_path / "rays.npz", 100)) == len(rays)


def test_a_folder_that_is_none(tmp_path):
    with pytest.raises(NergError, match="is no dataset of rays"):
        load_rays(tmp_path)
