"""A place cut at a height: boxes whose walls and heights are known."""

from __future__ import annotations

import numpy as np

from nerg_mi.workflows.draw_scenes import cut_place

LOW, HIGH = np.array([-2.0, -1.0]), np.array([2.0, 1.0])
SCENE = """<scene version="3.0.0"><integrator type="nerg"/>
<shape type="rectangle"><transform name="to_world"><scale value="5"/></transform></shape>
<shape type="cube"><transform name="to_world"><scale x="0.3" y="0.4" z="0.25"/>
  <translate x="-1" y="0" z="0.25"/></transform></shape>
<shape type="cube"><transform name="to_world"><scale x="0.5" y="0.2" z="1"/>
  <translate x="1" y="0.3" z="1"/></transform></shape></scene>"""


def test_boxes(rgb, tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    scene = rgb.load_file(str(tmp_path / "scene.xml"))
    plan = cut_place(scene.integrator(), scene, LOW, HIGH, 1.2, 0.0)
    ny, nx = plan.height.shape
    side = (plan.high - plan.low) / (nx, ny)
    assert plan.level == 1.2 and np.allclose(side, side[0])
    x, y = plan.low[0] + (np.arange(nx) + 0.5) * side[0], plan.low[1] + (np.arange(ny) + 0.5) * side[0]
    x, y = np.meshgrid(x, y)
    low_box = (np.abs(x + 1) < 0.3) & (np.abs(y) < 0.4)
    tall_box = (np.abs(x - 1) < 0.5) & (np.abs(y - 0.3) < 0.2)
    np.testing.assert_allclose(plan.height[low_box], 0.5, atol=1e-4)
    np.testing.assert_allclose(plan.height[~low_box & ~tall_box], 0.0, atol=1e-4)
    # The cut goes along the walls of the tall box, a cell wide to each side, and nowhere else.
    edge = np.maximum(np.abs(x - 1) - 0.5, np.abs(y - 0.3) - 0.2)
    assert plan.cut[np.abs(edge) < 0.4 * side[0]].all() and not plan.cut[np.abs(edge) > 1.01 * side[0]].any()
