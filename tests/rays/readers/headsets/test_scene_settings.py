"""Settings of EyeNavGS's places."""

import numpy as np
import pytest

from nerg_mi.rays.readers.eyenavgs import read_scene_settings


def test_there_and_back(tmp_path):
    """A quarter turn about z, two units a metre, the play area a metre along x."""
    (tmp_path / "s.csv").write_text(
        'Scene_Name,Quaternion,Scale,Initial_Position\nhall,"0, 0, 0.70710678, 0.70710678",2,"1, 0, 3"\n'
    )
    setting = read_scene_settings(tmp_path / "s.csv")["hall"]
    assert setting.start == (1, 0, 3) and np.allclose(setting.upright, [[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    x = np.array([[1.0, 0, 3], [3, 4, 5]])
    assert np.allclose(setting.to_area(x), [[1, 1, 6], [-1, 2, 7]])
    there = np.c_[setting.to_area(x), [1, 1]] @ setting.splat_from_area().T
    assert np.allclose(there, np.c_[x * (1, -1, -1), [1, 1]])


def test_what_is_refused(tmp_path):
    (tmp_path / "s.csv").write_text('Scene_Name,Quaternion,Scale,Initial_Position\nhall,"0, 0, 0, 1",2,"1, 0"\n')
    with pytest.raises(ValueError, match="s.csv.*2.*'hall'"):
        read_scene_settings(tmp_path / "s.csv")
    (tmp_path / "s.csv").write_text("Place,Scale\nhall,2\n")
    with pytest.raises(ValueError, match="no column Scene_Name, Quaternion"):
        read_scene_settings(tmp_path / "s.csv")
