import json

import numpy as np
import pytest

from nerg_mi.alignment.check import Alignment, read_similarity
from nerg_mi.alignment.constraints import Fit
from nerg_mi.errors import NergError


def written(path):
    fit = Fit(
        np.diag([2.0, 2, 2, 1]),
        np.arange(5.0),
        np.array([1.0, np.nan]),
        np.diag([1e-4] * 3 + [4e-4] * 3 + [1e-4]),
        about={"pairs": 5},
    )
    found = Alignment.of_fit("pairs", fit, {"rays": {"file": "a.npz", "sha256": "00"}}, False)
    found.save(path)
    return found


def test_what_is_written_is_read_by_every_command(tmp_path):
    path = tmp_path / "alignment.json"
    found = written(path)
    assert read_similarity(path, "--align", "rays to field").scale == pytest.approx(2)
    about = json.loads(path.read_text())
    assert about["evidence"] == {"kind": "pairs", "pairs": 5} and about["residuals"]["median_cm"] == 2
    assert about["uncertainty"]["cm"] == pytest.approx(100 * np.sqrt(12e-4) / 2)
    assert about["uncertainty"]["scale_percent"] == pytest.approx(1) and found.residuals["median_degrees"] == 1
    assert about["uncertainty"]["degrees"] == pytest.approx(np.degrees(np.sqrt(3e-4)))


@pytest.mark.parametrize(
    "change, why",
    [
        ({"version": 99}, "version 99, and up to 1 is read"),
        ({"version": True}, "version True"),
        ({"kind": "x"}, "neither that"),
        ({"matrix": [[1, 2]]}, "--align"),
        ({"matrix": np.diag([1.0, 2, 1, 1]).tolist()}, "--align"),
    ],
)
def test_other_files_are_refused(tmp_path, change, why):
    path = tmp_path / "alignment.json"
    written(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(NergError, match=why):
        read_similarity(path, "--align", "rays to field")
