"""Bakes in parts: the sums of one go to the bit, whoever makes the parts, and only what has to be made."""

from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest
from nerg_mi.scenes import store as ready

from nerg_mi.errors import NergError
from nerg_mi.formats.ply import write_columns
from nerg_mi.formats.splats import write_ply_splats
from nerg_mi.rays.rays import Rays
from nerg_mi.surfaces.sources import Crowd, GazeSettings, RaySettings, TrackedRays
from nerg_mi.tasks.engines import Output
from nerg_mi.workflows import bake_chunks
from nerg_mi.workflows.bake import bake
from nerg_mi.workflows.bake_chunks import (
    BakeScene,
    PlannedBake,
    SplatScene,
    bake_part,
    halves_of,
    read_sums,
    sums_in_one_go,
    sums_in_parts,
)
from nerg_mi.workflows.options import PartOptions
from nerg_mi.workflows.parts import Parts
from nerg_mi.workflows.scene_commands import BakeOptions
from tests.conftest import ROOT
from tests.plugins import fields
from tests.surfaces.meshes import box, joined
from tests.surfaces.test_splats import falling
from tests.surfaces.walls import wall
from tests.tasks.works import laid_out
from tests.workflows.recorder import Recorder

ROOM = joined(box((0, 0, 0), (8, 6, 3)))
GAZE = files(ready) / "shoppers.safetensors"
RAYS = RaySettings(cone=0.03, bundle=4)


@pytest.fixture(autouse=True)
def engine(rgb, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setattr(bake_chunks, "RAYS", 300)
    monkeypatch.setattr(bake_chunks, "OBSERVERS", 2)


def crowd(n):
    at = np.random.default_rng(1).uniform((3, 2, 1.4), (5, 4, 1.8), (n, 3))
    return Crowd(at, np.full(n, 1 / n))


def rays(n, seed=0):
    d = np.random.default_rng(seed).normal(size=(n, 3))
    return TrackedRays(np.full((n, 3), 1.5), d / np.linalg.norm(d, axis=1, keepdims=True), np.full(n, 1 / n))


def parts(folder, told=None, **options):
    return Parts(PartOptions(store=folder, **options), folder / "a.ply", told or Recorder(), 1)


def made(told):
    """How many parts were not kept from before."""
    return int(told.steps[-1][1].split()[0]) - int(told.steps[0][1].split()[0])


def equal(one, other):
    return all(
        np.array_equal(a.face, b.face)
        and np.array_equal(a.vertex, b.vertex)
        and (a.elsewhere, a.escaped, a.total, a.weight, a.count) == (b.elsewhere, b.escaped, b.total, b.weight, b.count)
        for a, b in zip(one, other, strict=True)
    )


@pytest.mark.nightly
def test_two_processes_give_the_sums_of_one_and_what_is_kept_is_not_made_again(tmp_path):
    scene = BakeScene(ROOM, gaze=GAZE, of_gaze=GazeSettings(angle=0.5, directions=1024), of_rays=RAYS)
    groups = [crowd(3), rays(500)]
    whole = sums_in_one_go(scene, groups, Recorder())
    assert equal(sums_in_parts(scene, groups, parts(tmp_path, scheduler="local:2"), "a bake"), whole)
    # Started again with two observers more: one part is another one, and one is new.
    told = Recorder()
    more = [Crowd(np.r_[groups[0].positions, groups[0].positions[:2]], np.full(5, 1 / 3)), groups[1]]
    sums_in_parts(scene, more, parts(tmp_path, told), "a bake")
    assert told.steps[-1][1].startswith("5 of 5 parts") and made(told) == 2


def test_a_part_depends_on_what_it_reads_and_on_nothing_else(tmp_path):
    def bake_rays(scene, who):
        told = Recorder()
        sums_in_parts(scene, [who], parts(tmp_path, told), "a bake")
        return made(told)

    scene = BakeScene(ROOM, of_rays=RAYS)
    who = rays(900)
    assert bake_rays(scene, who) == 3 and bake_rays(scene, who) == 0
    # Some rays of the second part are others.
    who.directions[400:500] *= -1
    assert bake_rays(scene, who) == 1
    # The mesh is another one.
    higher = replace(ROOM, vertices=ROOM.vertices * (1, 1, 1.5))
    assert bake_rays(replace(scene, mesh=higher), who) == 3
    assert bake_rays(replace(scene, of_rays=RaySettings(cone=0.02, bundle=4)), who) == 3


def test_files_that_were_sent_serve_as_those_that_lie_there(tmp_path):
    """A worker of another machine has what it was sent in a folder of its own."""
    plain = wall(0.0, 0.4, 0.05)
    write_ply_splats(tmp_path / "wall.ply", plain)
    for scene, who in (
        (
            BakeScene(ROOM, (box((1, 1, 0), (2, 2, 1)),), GAZE, of_gaze=GazeSettings(angle=0.5, directions=1024)),
            crowd(1),
        ),
        (SplatScene(tmp_path / "wall.ply", len(plain), of_rays=RAYS), falling(100)),
    ):
        there = laid_out(PlannedBake.of(scene), tmp_path / "there")
        notes = bake_part(there, who, tmp_path / "a.npy")
        found = read_sums(Output(tmp_path / "a.npy", notes), len(scene.nothing.face))
        assert there != PlannedBake.of(scene) and equal([found], sums_in_one_go(scene, [who], Recorder()))


@pytest.mark.nightly
def test_two_processes_give_the_sums_of_splats(tmp_path):
    plain = wall(0.0, 0.4, 0.05)
    write_ply_splats(tmp_path / "wall.ply", plain)
    fields.gaze(tmp_path / "gaze.safetensors")
    scene = SplatScene(tmp_path / "wall.ply", len(plain), tmp_path / "gaze.safetensors", of_rays=RAYS)
    groups = [falling(500, 0.5), crowd(2)]
    there = sums_in_parts(scene, groups, parts(tmp_path, scheduler="local:2"), "a bake")
    assert equal(there, sums_in_one_go(scene, groups, Recorder()))


def test_halves_are_of_people():
    n = 40
    given = Rays(
        np.arange(n) / 10, np.arange(n) % 4, tuple("abcd"), np.ones((n, 3)), np.eye(3)[np.arange(n) % 3], np.ones(n)
    )
    first, second = halves_of(rays(n), given, 0)
    assert len(first) == len(second) == 20 and (first.first, second.first) == (0, 20)
    with pytest.raises(NergError, match="two people at least"):
        halves_of(rays(n), replace(given, person=np.zeros(n, int)), 0)


def test_the_files_of_a_bake_have_the_same_bytes(tmp_path):
    v, f = box((0, 0, 0), (8, 6, 3))
    write_columns(tmp_path / "room.ply", dict(zip("xyz", v.T)), f)
    n = 1000
    d = rays(n).directions
    given = Rays(np.arange(n) / 10, np.arange(n) % 2, ("a", "b"), np.full((n, 3), 1.5), d, np.ones(n))
    given.save(tmp_path / "rays.npz")
    common = {"rays": tmp_path / "rays.npz", "detail": 2.0, "halves": True, "mode": "llvm_ad_rgb"}
    for folder, more in (("one", {}), ("parts", {"store": tmp_path / "store"})):
        outputs = [tmp_path / folder / f"a{suffix}" for suffix in (".ply", ".glb", ".csv", ".json")]
        bake(tmp_path / "room.ply", outputs, BakeOptions(**common, **more))
    names = sorted(p.name for p in (tmp_path / "one").iterdir())
    assert len(names) == 4 and names == sorted(p.name for p in (tmp_path / "parts").iterdir())
    for name in names:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes(), name
