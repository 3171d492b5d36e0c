"""The demo store: a procedural convenience store of 8 x 6 x 3 m, generated from a seed by ``make.py``.

`layout` and `furniture` build the geometry, `twin` converts it to Mitsuba shapes and casts exact rays, `cameras` and
`views` render posed pictures with depth, `attention_law` defines the true gaze density of the shoppers in closed form,
and `shoppers` simulates their walks. Frame: x east, y north, z up, metres.
"""

from pathlib import Path

SCENE_FILE = Path(__file__).resolve().with_name("scene.xml")
"""The scene file, with the trained fields."""
