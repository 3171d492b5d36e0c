"""Readers of tracking data: files of gaze samples, tables, skeletons and recordings of headsets."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import numpy as np

from nerg_mi.tracking.readers.registry import list_reader_names
from tests.fuzz.watch import Reader
from tests.tracking.readers.examples import EXAMPLES, TABLE, VARIANTS, Example, write_walk


def _rays():
    from nerg_mi.tracking.rays import Rays

    rng = np.random.default_rng(0)
    d = rng.normal(size=(40, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    origin = rng.random((40, 3)) + [0, 0, 1.4]
    cohort = np.arange(40) % 2
    # A wide character, so that the module that formats it is imported before the first damaged case.
    rays = Rays(
        np.arange(40) * 0.02,
        np.arange(40) % 3,
        ("a", "b", "\u540d"),
        origin,
        d,
        np.ones(40),
        origin + 2 * d,
        cohort=cohort,
        cohorts=("x", "y"),
    )
    metadata = {
        "transform": np.eye(4).tolist(),
        "sources": [{"file": "a.csv", "sha256": "00" * 32}],
        "rows_read": 42,
        "tick": 1.0,
        "dropped": [{"reason": "blink", "file": "a.csv", "count": 2, "rows": [[3, 4]]}],
        "source_frame": {"up": "y", "handedness": "left", "units": "m"},
    }
    rays.metadata.update(metadata)
    where = {"position": {"radius": 0.25, "zones": 1, "zone_radius": 0.2, "test_centres": [[0.0, 0.0, 1.5]]}}
    return rays.with_step(step="filter", kept=40, of=41, persons=["a"]).with_step(
        step="split", side="test", kept=40, of=40, by=where
    )


def _shown(rays) -> None:
    """Use gaze samples as the commands do: quality report, selection, pseudonyms."""

    from nerg_mi.tracking.filters import select_mask
    from nerg_mi.tracking.pseudonyms import pseudonymise
    from nerg_mi.tracking.quality import check_rays

    str(check_rays(rays))
    rays.select(select_mask(rays, time=(0, 1), with_hit=True))
    pseudonymise(rays, bytes(16))


def _rays_file(name: str, *kinds: str) -> Reader:
    def read(folder: Path) -> None:
        from nerg_mi.tracking.rays import Rays

        _shown(Rays.load(folder / name))

    return Reader(f"rays {name}", lambda folder: _rays().save(folder / name), {name: kinds}, read, _needed(name))


def _needed(name: str) -> str | None:
    """Return the package that is required to read files with that name."""
    return "pyarrow" if name.endswith(".parquet") else None


def _make_metadata(folder: Path) -> None:
    rays = _rays()
    metadata = {"version": 1, **rays.metadata, "persons": list(rays.persons), "cohorts": list(rays.cohorts)}
    (folder / "metadata.json").write_text(json.dumps(metadata))


def _read_metadata(folder: Path) -> None:
    from dataclasses import replace

    from nerg_mi.files.safe_read import MAX_JSON_BYTES, read_bytes
    from nerg_mi.tracking.rays import read_metadata

    raw = read_bytes(folder / "metadata.json", "rays file", MAX_JSON_BYTES)
    metadata = read_metadata(raw, folder / "metadata.json")
    persons, cohorts = metadata.pop("persons"), metadata.pop("cohorts", [])
    _shown(replace(_rays(), metadata=metadata, persons=persons, cohorts=cohorts))


def _recording(name: str, example: Example, kind: str = "") -> Reader:
    """Make a reader ``name`` of an example, of which any file may be damaged."""
    skip = kind == " skipping"

    def make(folder: Path) -> None:
        example.make(folder)

    def read(folder: Path) -> None:
        from nerg_mi.tracking.readers.registry import make_options, read_rays

        options = make_options(name, example.options_in(folder))
        _shown(read_rays(name, example.path_in(folder), options, skip_bad_lines=skip))

    columns = {".gz": ("gzip",), ".json": ("json",), ".g3": ("json",), ".mp4": ("boxes",), ".c3d": ()}
    kinds = {file: columns.get(Path(file).suffix, ("text",)) for file in example.files}
    return Reader(f"preset {name}{kind}", make, kinds, read, "c3d" if name == "c3d" else None)


def _tables(name: str, make, *kinds: str) -> Reader:
    """Make a reader of tables for files other than its example."""

    def read(folder: Path) -> None:
        from nerg_mi.tracking.readers.registry import make_options, read_rays

        _shown(read_rays("table", folder / name, make_options("table", EXAMPLES["table"].options)))

    return Reader(f"table {name}", lambda folder: make(folder / name), {name: kinds}, read, _needed(name))


def _guess(name: str, make, *kinds: str) -> Reader:
    """Read the proposal for a damaged table without applying it."""

    def read(folder: Path) -> None:
        from nerg_mi.tracking.guess import propose_import

        propose_import(folder / name).command  # noqa: B018

    return Reader(f"guess {name}", lambda folder: make(folder / name), {name: kinds}, read, _needed(name))


def _make_parquet(path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    names = "t x y z a b c conf h i j".split()
    columns = {name: np.arange(60.0) / 50 for name in names}
    pq.write_table(pa.table({**columns, "conf": np.ones(60), "who": ["ann", "bo"] * 30}), path)


def _skeletons(name: str, *kinds: str) -> Reader:
    def read(folder: Path) -> None:
        from nerg_mi.tracking.readers.skeleton import iterate_skeleton

        list(iterate_skeleton(folder / name))

    return Reader(f"skeleton {name}", lambda folder: write_walk(folder / name), {name: kinds}, read)


def _make_salt(folder: Path) -> None:
    (folder / "salt").write_bytes(bytes(range(32)))


def _read_salt(folder: Path) -> None:
    from nerg_mi.tracking.pseudonyms import read_salt

    read_salt(folder / "salt")


_PAIRS = np.random.default_rng(0).normal(size=(5, 6)).tolist()


def _make_pairs(folder: Path) -> None:
    rows = "".join(f"p{k},{','.join(map(str, row))}\n" for k, row in enumerate(_PAIRS))
    (folder / "pairs.csv").write_text("name,x,y,z,place_x,place_y,place_z\n" + rows)
    (folder / "pairs.json").write_text(json.dumps([{"tracking": r[:3], "place": r[3:], "name": "p"} for r in _PAIRS]))


def _pairs(name: str, kind: str) -> Reader:
    def read(folder: Path) -> None:
        from nerg_mi.alignment.constraints import AlignmentTarget
        from nerg_mi.alignment.points import read_pairs

        read_pairs(folder / name).fit(AlignmentTarget(is_upright=False), lambda *_: None)

    return Reader(f"alignment {name}", _make_pairs, {name: (kind,)}, read)


def _make_alignment(folder: Path) -> None:
    from nerg_mi.formats.alignments import Alignment

    Alignment(np.diag([2.0, 2, 2, 1]), {"kind": "pairs"}, {"count": 5}, None).save(folder / "alignment.json")


def _read_alignment(folder: Path) -> None:
    from nerg_mi.formats.alignments import read_similarity

    read_similarity(folder / "alignment.json", "--align", "rays to field")


def _surface(name: str, *kinds: str) -> Reader:
    def make(folder: Path) -> None:
        import trimesh

        box = trimesh.creation.box((1, 2, 3))
        if name.endswith(".npy"):
            np.save(folder / name, box.vertices)
        elif name.endswith(".csv"):
            (folder / name).write_text("x,y,z\n" + "".join(f"{x},{y},{z}\n" for x, y, z in box.vertices))
        else:
            box.export(folder / name)

    def read(folder: Path) -> None:
        from nerg_mi.alignment.constraints import read_surface

        read_surface(folder / name, 500)

    return Reader(f"surface {name}", make, {name: kinds}, read)


_SOURCE = "0" * 32
_PART = f"a.rays/place=shop/day=unknown/bucket=0/part-{_SOURCE}-0.parquet"


def _make_dataset(folder: Path) -> None:
    from nerg_mi.tracking.dataset import DatasetManifest, write_dataset_manifest
    from nerg_mi.tracking.dataset_write import SourceWriter

    rays = _rays()
    write_dataset_manifest(folder / "a.rays", DatasetManifest(1))
    writer = SourceWriter(folder / "a.rays", _SOURCE, 1)
    writer.add(rays, "shop")
    writer.finish(rays.metadata, file="a.csv", where="w", stamp=None, recipe="r", generation=0)


def _read_dataset(folder: Path) -> None:
    from nerg_mi.tracking.dataset import Conditions, RayDataset
    from nerg_mi.tracking.quality import check_environments

    list(map(str, check_environments(folder / "a.rays")))
    dataset = RayDataset.open(folder / "a.rays")
    dataset.sample(7, runs=2)
    list(dataset.scan(Conditions(time=(0, 0.3), box=[0, 1, 0, 1, 0, 3], with_hit=True), whole_parts=True))


def _dataset(name: str, target: str, *kinds: str) -> Reader:
    return Reader(f"dataset {name}", _make_dataset, {f"a.rays/{target}": kinds}, _read_dataset, "pyarrow")


TRACKING = [
    _rays_file("rays.npz", "zip"),
    _rays_file("rays.parquet"),
    Reader("rays metadata", _make_metadata, {"metadata.json": ("json",)}, _read_metadata),
    *(_recording(name, EXAMPLES[name], kind) for name in list_reader_names() for kind in ("", " skipping")),
    *(
        _recording(name, example, f" {k}")
        for name, examples in VARIANTS.items()
        for k, example in enumerate(examples, 2)
    ),
    _tables("gaze.csv.gz", lambda path: path.write_bytes(gzip.compress(TABLE.encode(), mtime=0)), "gzip"),
    _tables("gaze.parquet", _make_parquet),
    _guess("gaze.csv", lambda path: path.write_text(TABLE), "text"),
    _guess("gaze.parquet", _make_parquet),
    _skeletons("day.csv", "text"),
    _skeletons("day.csv.gz", "gzip"),
    _pairs("pairs.csv", "text"),
    _pairs("pairs.json", "json"),
    Reader("alignment", _make_alignment, {"alignment.json": ("json",)}, _read_alignment),
    _surface("points.ply"),
    _surface("points.obj", "text"),
    _surface("points.csv", "text"),
    _surface("points.npy", "npy"),
    _dataset("head", "_dataset.json", "json"),
    _dataset("account", f"_sources/{_SOURCE}.json", "json"),
    _dataset("part", _PART.partition("/")[2]),
    Reader("salt", _make_salt, {"salt": ()}, _read_salt),
]
"""Every reader of the registry is among them; one without an example is an error here."""
