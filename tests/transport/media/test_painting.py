"""What samples contribute to a sum: the medium's colour, in the array type that was asked for."""

import numpy as np
import pytest

from nerg_mi.transport.medium import ColorPainter
from nerg_mi.transport.volume_medium import VolumeMedium


@pytest.mark.parametrize("kind", ["Color3f", "Spectrum", "Vector3f"])
def test01_the_mediums_colour(rgb, kind):
    array_type = getattr(rgb, kind)
    data = np.broadcast_to(np.float32([0.2, 0.5, 0.8]), (2, 2, 2, 3)).copy()
    color = rgb.load_dict({"type": "gridvolume", "grid": rgb.VolumeGrid(data), "raw": True})
    medium, painter = (
        VolumeMedium(rgb.load_dict({"type": "constvolume", "value": 1.0}), color),
        ColorPainter(array_type),
    )
    p, w = rgb.Point3f(0.5, 0.5, 0.5), rgb.Vector3f(0, 0, 1)
    found = painter.paint(medium, [], p, w, rgb.Bool(True))
    assert type(found) is type(painter.zero()) is array_type
    assert np.allclose(np.array(found).ravel(), [0.2, 0.5, 0.8], atol=1e-6)
    assert not np.array(painter.zero()).any()
    assert painter.color(medium, found, rgb.Float(0.5), medium.local(p, w), rgb.Bool(True)) is found
