"""Gaze angles and models of Aria's glasses."""

import numpy as np
import pytest

from nerg_mi.rays.readers.aria import GEN2, LEGACY, VERGENCE, cpf_in_device, device_named, gaze_in_cpf, schema_of


def test_schemas_by_their_headers(tmp_path):
    legacy = "tracking_timestamp_us,yaw_rads_cpf,pitch_rads_cpf,depth_m"
    vergence = "tracking_timestamp_us,left_yaw_rads_cpf,right_yaw_rads_cpf,pitch_rads_cpf,depth_m,session_uid"
    gen2 = f"{vergence},yaw_rads_cpf,left_pitch_rads_cpf,right_pitch_rads_cpf"
    for header, schema in ((legacy, LEGACY), (vergence, VERGENCE), (gen2, GEN2), (f"{legacy},session_uid", LEGACY)):
        (tmp_path / "gaze.csv").write_text(header + "\n")
        assert schema_of(tmp_path / "gaze.csv") is schema
    (tmp_path / "gaze.csv").write_text("time,x\n")
    with pytest.raises(ValueError, match="gaze.csv"):
        schema_of(tmp_path / "gaze.csv")


def test_directions_of_tangents():
    eighth = np.pi / 4
    eye, direction, distance = gaze_in_cpf(LEGACY, np.array([[0, eighth, eighth, 3.0], [0, 0, 0, 0], [0, 0, 1.6, 1]]))
    assert np.allclose(direction[:2], [np.ones(3) / np.sqrt(3), [0, 0, 1]]) and np.isnan(direction[2]).any()
    assert distance[0] == 3 and np.isnan(distance[1]) and not eye.any()
    # To the left of the left eye, at 45 degrees: the mean of the tangents.
    _, direction, distance = gaze_in_cpf(VERGENCE, np.array([[0, np.arctan(0.9), np.arctan(1.1), 0, 0.5]]))
    assert np.allclose(direction, [[np.sqrt(0.5), 0, np.sqrt(0.5)]]) and distance[0] == 0.5


def test_polar_directions_and_eyes():
    eyes = [0.03, 0.001, 0.002, -0.034, 0.003, 0.002]
    eye, direction, distance = gaze_in_cpf(GEN2, np.array([[0, np.pi / 4, np.pi / 4, *eyes], [0, 1.6, 0, *eyes]]))
    assert np.allclose(direction[0], [0.5, np.sqrt(0.5), 0.5]) and np.isnan(direction[1]).all()
    assert np.allclose(eye, [-0.002, 0.002, 0.002]) and np.isnan(distance).all()


@pytest.mark.parametrize("name", ["DVT-S", "DVT-L", "DVT-LL", "DVT-LS", "DVT-SL", "DVT-SS"])
def test_the_eyes_are_behind_the_camera(name):
    """The device's frame is the left camera's: some 7 cm to the left of the eyes' middle and ahead of it."""
    R, t = cpf_in_device(name)
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-12) and np.isclose(np.linalg.det(R), 1)
    camera = -R.T @ t
    assert 0.066 < camera[0] < 0.072 and 0 < camera[1] < 0.007 and 0.008 < camera[2] < 0.012


def test_names_of_models():
    assert device_named(None, 1) == "DVT-L" and device_named(None, 2) == "DVT-LL"
    assert device_named("dvt_s", 1) == "DVT-S" and device_named("DVT-SL", 2) == "DVT-SL"
    with pytest.raises(ValueError, match='"dvt-s"'):
        device_named("dvt-s", 2)
    with pytest.raises(ValueError, match='"Neon" is no model'):
        device_named("Neon", 1)
