"""Layout of a seed: triangles, their materials, and lights."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from nerg_mi.scenes.tabletop import outside, room, table
from nerg_mi.scenes.tabletop import textures as t
from nerg_mi.scenes.tabletop.mesh import Mesh, MeshBuilder


@dataclass(frozen=True)
class Material:
    """A material.

    ``paint`` makes the bitmap (h, w, 3) of sRGB values from a random stream; ``gloss`` adds a coat; ``radiance`` (3,)
    is emitted, in W/m²/sr, with the ``sampling_weight`` of its light.
    """

    paint: Callable[[np.random.Generator], np.ndarray]
    gloss: bool = False
    radiance: tuple[float, float, float] | None = None
    sampling_weight: float = 1.0


def _make_plain(color: str, uneven: float = 0.3) -> Material:
    """Return a material of one colour with brightness variations of ± half of ``uneven``."""
    return Material(
        lambda rng: (
            t.parse_colors(color) * (1 - uneven / 2 + uneven * t.make_noise(rng, (128, 128), (8, 8), 4)[..., None])
        )
    )


MATERIALS = {
    "table": Material(t.wood, gloss=True),
    "wood": Material(lambda rng: t.wood(rng, 512, "a5774a", "c1935f", "d8b27f")),
    "stool": _make_plain("38506b"),
    "runner": Material(lambda rng: t.weave(rng, 256, 32, "b53a2d", "e6d7b5", "2c4a68", "d99a35")),
    "vase": Material(t.ceramic, gloss=True),
    "bowl": Material(
        lambda rng: t.interpolate_colors(t.make_noise(rng, (256, 256), (4, 8)), "3d6f78", "5d97a0", "86b8ba"),
        gloss=True,
    ),
    "mug": Material(lambda rng: t.weave(rng, 256, 12, "e8e2d2", "cf5b3c", "e8e2d2", "2b4d73"), gloss=True),
    "apple": Material(
        lambda rng: t.interpolate_colors(t.make_noise(rng, (128, 128), (12, 3)), "8f1f1c", "c23a2a", "d9a441"), True
    ),
    "orange": Material(
        lambda rng: t.interpolate_colors(t.make_noise(rng, (128, 128), (32, 32)), "d2741c", "e89232"), True
    ),
    "lemon": Material(
        lambda rng: t.interpolate_colors(t.make_noise(rng, (128, 128), (24, 24)), "cdb02c", "e8d25a"), True
    ),
    "soil": _make_plain("3a2a1e", 0.8),
    "leaf": Material(lambda rng: t.foliage(rng, 256, "2c4a1c", "4f7a31", "7fa34c")),
    "blossom": Material(t.blossoms),
    "books": Material(t.spines),
    "pictures": Material(t.pictures),
    "floor": Material(t.planks),
    "rug": Material(t.carpet),
    "ceiling": _make_plain("dedbd2", 0.12),
    "wall": Material(t.plaster),
    "paint": _make_plain("e4e0d6", 0.15),
    "dark": _make_plain("33302d"),
    "metal": _make_plain("a8a49a", 0.1),
    "curtain": Material(lambda rng: t.weave(rng, 256, 16, "b9a889", "8c5f48", "cfc3aa", "7e8c6d")),
    "sofa": Material(t.weave),
    "cushion": Material(lambda rng: t.weave(rng, 256, 24, "a8652f", "c98a4b", "7d4a26", "d8b98c")),
    "bark": _make_plain("5a4634", 0.7),
    "tree": Material(t.foliage),
    "oak": Material(lambda rng: t.foliage(rng, 512, "232a10", "5a6a2a", "8f9a44", "c2b25a")),
    "hedge": Material(lambda rng: t.foliage(rng, 512, "142a12", "2f5426", "5c8440")),
    "hill": Material(lambda rng: t.foliage(rng, 512, "56704f", "6f8a66", "8aa07c")),
    "grass": Material(t.grass),
    "paving": Material(partial(t.plaster, color="b5aa98", motif="6f675c")),
    "facade": Material(t.facades),
    "plaster": _make_plain("cdbfa3"),
    "roof": Material(t.tiles),
    "panel": Material(lambda rng: np.full((2, 2, 3), 0.9), radiance=(6.3, 6.0, 5.5), sampling_weight=3.0),
    "shade": Material(lambda rng: np.full((2, 2, 3), 0.9), radiance=(0.9, 0.8, 0.6), sampling_weight=0.1),
}


@dataclass(frozen=True)
class TabletopLayout:
    """The finished geometry: a mesh for each of `MATERIALS`. ``seed`` is that of its generation."""

    seed: int
    meshes: dict[str, Mesh]

    @property
    def triangles(self) -> np.ndarray:
        """Corners (F, 3, 3) of all triangles."""
        return np.concatenate([mesh.triangles for mesh in self.meshes.values()])


def build_tabletop(seed: int = 0) -> TabletopLayout:
    """Build the scene of a seed. Furniture is fixed; flowers, books, houses and trees vary."""
    builder = MeshBuilder()
    for name, part in (("table", table.add_table), ("room", room.add_room), ("outside", outside.add_landscape)):
        part(builder, make_random_stream(seed, name))
    return TabletopLayout(seed, builder.join_meshes())


def make_random_stream(seed: int, name: str) -> np.random.Generator:
    """Return the random stream of a part of the scene, which does not depend on the draws of other parts."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])
