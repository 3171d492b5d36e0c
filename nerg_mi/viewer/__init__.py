"""An interactive view of a scene in the browser.

The browser draws points by itself while the camera or the observer moves. When both rest, one thread that owns Mitsuba
and Dr.Jit refines a picture of the scene (`session`). `page` connects the browsers to this thread, `controls`
and `scene` build the panel, and `server` restricts who can connect.
"""
