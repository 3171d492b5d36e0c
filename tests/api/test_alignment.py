import json

import numpy as np
import pytest

import nerg_mi as nerg

ROWS = "0,0,0,1,0,0\n2,0,0,5,0,0\n0,1,0,1,2,0\n0,0,1,1,0,2\n"


def test_files_may_be_named_by_strings_and_options_are_checked(tmp_path):
    (tmp_path / "p.csv").write_text("x,y,z,place_x,place_y,place_z\n" + ROWS)
    found = nerg.align(output=str(tmp_path / "a.json"), pairs=str(tmp_path / "p.csv"))
    np.testing.assert_allclose(found.matrix, json.loads((tmp_path / "a.json").read_text())["matrix"])
    np.testing.assert_allclose(found.matrix[:3, :3], 2 * np.eye(3), atol=1e-12)
    with pytest.raises(nerg.NergError, match='"pair".*"pairs"'):
        nerg.align(pair="p.csv")
