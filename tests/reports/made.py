"""A report run with all kinds of data, and names that contain markup."""

from __future__ import annotations

import json

import numpy as np

from nerg_mi.evaluation.gaze_report import GazeResults
from nerg_mi.formats.boxes import Region
from nerg_mi.reports.data import (
    MeanShare,
    ObjectAttention,
    ReportCamera,
    ReportPicture,
    ReportProxy,
    Run,
    Stage,
    pack_stage,
)
from nerg_mi.tracking.quality import summarise
from tests.evaluation.test_gaze import crowd
from tests.evaluation.test_gaze_report import scored

HOSTILE = "<script>alert(1)</script>\"'&\u202egnp.exe<img src=http://example.org/x onerror=alert(2)>"
"""A name that contains markup, breaks out of attributes and changes the text direction."""

PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d4948445200000001000000010802000000907753de0000000c49444154789c63f8cfc000000301010018dd8db00000"
    "000049454e44ae426082"
)


def cube(side: int = 12) -> ReportProxy:
    """The six faces of a room of 4 m, seen from inside, and the gaze of two observers."""
    axis = np.linspace(0, 4, side)
    u, v = (m.ravel() for m in np.meshgrid(axis, axis))
    points, normals = [], []
    for a in range(3):
        for end in (0.0, 4.0):
            face = np.insert(np.stack([u, v], axis=1), a, end, axis=1)
            points.append(face)
            normals.append(np.tile(np.eye(3)[a] * (1 if end == 0 else -1), (len(face), 1)))
    p, n = np.concatenate(points), np.concatenate(normals)
    colors = (p / 4 * 255).astype(np.uint8)
    gaze = np.stack([np.exp(-np.linalg.norm(p - [4, 2, 2], axis=1)), np.exp(-np.linalg.norm(p - [2, 4, 2], axis=1))])
    return ReportProxy(p.astype(np.float32), n.astype(np.float32), colors, gaze.astype(np.float32), 4 / side)


SHELF = Region.create("shelf", np.zeros(3), np.ones(3))


def stage(boxes=(SHELF,)) -> Stage:
    path = np.stack([np.linspace(1, 3, 9), np.full(9, 2.0), np.full(9, 1.6)], axis=1)
    camera = ReportCamera(np.array([7.0, 6, 5]), np.array([2.0, 2, 1]))
    observers = np.array([[1.0, 2, 1.6], [3, 2, 1.6]])
    return Stage(cube(), observers, [path, path[:3]], boxes, np.array([0.0, 0, 1]), camera)


def full_run(name: str = "shelf") -> Run:
    """A run with all data; ``name``: name of files, participants and AOIs."""
    rays = crowd(400)
    picture = lambda words: ReportPicture(PNG, f"{words} {name}", f"{words} {name}.")
    share = MeanShare(0.25, 0.2, 0.3)
    person = {"method": "gaze field", "person": name, "rays": 12, "bits": 0.1, "CC": None, "KLD": 0.5}
    results = GazeResults(
        f"{name}.safetensors", "", "both", 60, 30, 20.0, tuple(scored((0.9, 0.85, 0.3), reach=0.02)), (person,)
    )
    provenance = dict(
        recipe=name,
        steps=160,
        rays=400,
        settings={"loss": name, "deep": {"rate": 0.01}},
        probes={"radius": 0.25},
        test={"centres": [[0, 0, 1]] * 3, "people": [name], "purged_within": 0.5},
        validation={"cc": 0.7, "kld": 0.4, "zones": 3, "probes": 60},
        rays_file={"file": name},
    )
    # Names of areas cannot contain characters that change the text direction.
    packed = stage((Region.create(name.replace("\u202e", "")[:80], np.zeros(3), np.ones(3)),))
    return Run(
        f"Gaze of {name}",
        {"provenance": provenance, "architecture": {"kind": name, "members": [1, 2]}, "box": {}},
        f"The place {name}.",
        "field",
        {"provenance": {"training_frames": 9}, "box": {"lower": [0, 0, 0], "upper": [4, 4, 4]}},
        "The observer stands somewhere.",
        rays,
        summarise(rays),
        (results,),
        (f"A doubt about {name}.",),
        (ObjectAttention(name, share, share, 3, 2, 4), ObjectAttention("other", share, share, 1, 0, 4)),
        12,
        1,
        (4, 1, 3),
        {n: picture(n) for n in ("color", "gaze", "own", "sphere", "spread", "plan", "layout")},
        pack_stage(packed),
        2,
        2,
        len(packed.proxy.vertices),
        1,
        (("gaze field", f"{name}.safetensors", "ab" * 32),),
        {"nerg_mi": name},
        {"seed": name},
    )


def minimal_run() -> Run:
    """A run with the minimum of data."""
    return Run("Gaze", {"kind": "gaze"}, "Nothing is known of the place.", "none")


def packed_scene(text: str) -> dict:
    """Return the 3D view embedded in a page."""
    start = text.index(">", text.index('id="stage-data"')) + 1
    return json.loads(text[start : text.index("</script>", start)])
