"""The demo store: a procedural convenience store of 8 x 6 x 3 m, made from a seed by ``make.py``.

`layout` and `furniture` build the place, `twin` makes it Mitsuba shapes and casts exact rays, `cameras` and `views`
take its posed pictures with depth, `attention_law` states in closed form where its shoppers look, `shoppers` walks them
about. Frame: x east, y north, z up, metres.
"""
