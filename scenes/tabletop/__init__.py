"""A table in a furnished room with windows: photos as taken by walking around the table, generated from a seed by
``make.py``.

`layout` combines the geometry of `table`, `room` and `outside`, built with `mesh` and textured with `textures`; `stage`
converts it to a Mitsuba scene, `cameras` places the cameras around the table, `photos` renders the photos with exact
depth, and `sparse` writes the COLMAP model. Frame: x east, y north, z up, metres.
"""
