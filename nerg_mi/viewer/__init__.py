"""A scene in the browser: a camera by mouse, an observer that is dragged, pictures that are refined when both rest.

The browser draws points or meshes at once (`proxy`); one thread owns Mitsuba and Dr.Jit and renders what is asked for,
the most urgent first (`worker`); `page` is what is seen of it, and `guard` says who may see it.
"""
