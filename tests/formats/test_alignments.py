"""Tests of `nerg_mi.formats.alignments`."""

import json

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.alignments import Alignment, read_similarity

MATRIX = np.diag([-2.0, -2, 2, 1]) + np.eye(4, k=3) * 0.5


def test_a_saved_alignment_is_loaded_again(tmp_path):
    record = {"kind": "pairs", "count": 5}, {"median_cm": 0.7}, {"position_cm": 0.2}, {"rays": {"file": "rays.npz"}}
    saved = Alignment(MATRIX, *record, forced=True)
    saved.save(tmp_path / "a.json")
    loaded = Alignment.load(tmp_path / "a.json")
    np.testing.assert_array_equal(loaded.matrix, MATRIX)
    assert (loaded.evidence, loaded.residuals, loaded.uncertainty, loaded.files) == record and loaded.forced
    np.testing.assert_array_equal(read_similarity(tmp_path / "a.json", "align", "rays to scene").matrix, MATRIX)
    assert "median cm" in loaded._repr_html_() and "0.7" in repr(loaded)


def test_rows_of_a_matrix_are_an_alignment(tmp_path):
    (tmp_path / "rows.json").write_text(json.dumps(MATRIX.tolist()))
    loaded = Alignment.load(tmp_path / "rows.json")
    np.testing.assert_array_equal(loaded.matrix, MATRIX)
    assert loaded.scale == pytest.approx(2) and loaded.uncertainty is None


@pytest.mark.parametrize("key, value", [("evidence", 3), ("uncertainty", [1]), ("files", None), ("forced", "yes")])
def test_damaged_records_are_refused(tmp_path, key, value):
    path = tmp_path / "a.json"
    Alignment(MATRIX, {"kind": "pairs"}, {}, None).save(path)
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    with pytest.raises(NergError, match=key):
        Alignment.load(path)
