"""The kinds of figures of scenes, in the order in which they are listed."""

from __future__ import annotations

from .floor import FLOOR_KIND
from .kind import Kind
from .sphere import SPHERE_KIND
from .triptych import TRIPTYCH_KIND

SCENE_KINDS: tuple[Kind, ...] = (SPHERE_KIND, TRIPTYCH_KIND, FLOOR_KIND)
