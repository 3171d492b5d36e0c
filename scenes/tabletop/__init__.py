"""A table in a furnished room with a view: photos as somebody takes them who walks around an object on a table, made
from a seed by ``make.py``.

`layout` puts the place together of `table`, `room` and `outside`, which `mesh` shapes and `textures` paints; `stage`
makes it a Mitsuba scene, `cameras` walks around the table, `photos` takes the pictures with exact depth, and `sparse`
writes the COLMAP model. Frame: x east, y north, z up, metres.
"""
