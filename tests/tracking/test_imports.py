"""Tests of `nerg_mi.tracking.imports`: tracking files in, rays or datasets out."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.alignments import read_similarity
from nerg_mi.tracking.dataset import RayDataset
from nerg_mi.tracking.imports import guess, import_rays
from nerg_mi.tracking.quality import check_environments
from nerg_mi.tracking.rays import Rays
from nerg_mi.tracking.readers.columns import ColumnMap
from nerg_mi.tracking.readers.table import TableOptions
from tests.recorder import Recorder
from tests.refusals import mentions
from tests.tracking.dataset.making import DAY, MAP, assert_same, write_source

COLUMNS = "origin=x,y,z direction=dx,dy,dz t=t person=who"


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "day.csv"
    path.write_text("t,who,x,y,z,dx,dy,dz\n0,Ada,100,200,160,1,0,0\n1,Bob,100,200,160,0,0,1\n")
    return path


@pytest.fixture
def salt(tmp_path):
    (tmp_path / "salt").write_bytes(bytes(range(32)))
    return tmp_path / "salt"


# ---- Files ----


def test_keywords_and_settings_are_options_of_the_reader(table):
    rays = import_rays(table, columns=COLUMNS, units="cm")
    assert np.allclose(rays.origin, [(1, 2, 1.6)] * 2) and rays.persons == ("Ada", "Bob")
    settings = TableOptions(columns=ColumnMap.parse(COLUMNS), units="cm")
    again = import_rays([table], "table", settings)
    assert np.array_equal(again.origin, rays.origin) and again.metadata == rays.metadata
    with pytest.raises(NergError, check=mentions("units", "settings")):
        import_rays(table, "table", settings, units="m")
    with pytest.raises(NergError, check=mentions("settings")):
        import_rays(table, "quest", settings)


def test_rays_are_written_and_reported(table, tmp_path):
    recorder, more = Recorder(), tmp_path / "more.csv"
    more.write_text(table.read_text())
    rays = import_rays([table, more], columns=COLUMNS, output=tmp_path / "rays.npz", progress=recorder)
    assert recorder.steps == [(0.0, "reading day.csv"), (0.5, "reading more.csv")]
    assert "4 of 4 rows" in recorder.messages[0] and recorder.messages[1] == f"wrote {tmp_path / 'rays.npz'}"
    saved = Rays.load(tmp_path / "rays.npz")
    assert len(rays) == 4 and all(np.array_equal(rays.columns()[k], v) for k, v in saved.columns().items())


def test_alignment_maps_rays_to_file_coordinates(table, tmp_path):
    rays = import_rays(table, columns=COLUMNS, up="-y", units="mm", align_output=tmp_path / "align.json")
    back = read_similarity(tmp_path / "align.json", "--align", "rays to field")
    assert np.isclose(back.scale, 1000.0)
    assert np.allclose(rays.origin @ back.matrix[:3, :3].T + back.matrix[:3, 3], [(100, 200, 160)] * 2)
    left = dict(up="y", handedness="left", align_output=tmp_path / "a.json", output=tmp_path / "none.npz")
    with pytest.raises(NergError, match="left-handed"):
        import_rays(table, columns=COLUMNS, **left)
    assert not (tmp_path / "none.npz").exists()


def test_a_salt_makes_pseudonyms_reproducible(table, salt):
    one, two, random = (import_rays(table, columns=COLUMNS, pseudonyms=p) for p in (salt, str(salt), "random"))
    assert one.persons == two.persons and not {"Ada", "Bob"} & {*one.persons, *random.persons}
    assert not set(one.persons) & set(random.persons)
    assert [r.metadata["pseudonyms"].partition(", ")[2] for r in (one, random)] == [
        "salt of a file",
        "random salt, not kept",
    ]


@pytest.mark.parametrize(
    "arguments, names",
    [
        ({"reader": "varjo", "tick": 0.1, "up": "y"}, ["tick", "up"]),
        ({"columns": {"time": "t"}}, ["columns"]),
        ({"columns": COLUMNS.replace("t=", "t=no")}, ["columns"]),
        ({"environment": "x"}, ["environment"]),
        ({"day": "2024-01-01", "output": "a.npz"}, ["day"]),
        ({"workers": 0, "output": "a.rays"}, ["workers"]),
        ({"align_output": "a.json", "output": "a.rays"}, ["align_output"]),
    ],
)
def test_wrong_arguments_are_refused(table, tmp_path, monkeypatch, arguments, names):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(NergError, check=mentions(*names)):
        import_rays(table, **({} if "reader" in arguments else {"columns": COLUMNS}) | arguments)
    assert [path.name for path in tmp_path.iterdir()] == ["day.csv"]


def test_wrong_files_are_refused(tmp_path):
    with pytest.raises(NergError, match="got ndarray; use Rays.from_dataframe"):
        import_rays(np.zeros(3))
    with pytest.raises(NergError, match=r"no\.csv"):
        import_rays(["no.csv"], "unity")
    with pytest.raises(NergError, match='"nope"'):
        import_rays("no.csv", "nope")
    for read in (guess, import_rays):
        with pytest.raises(NergError, match="no tracking files"):
            read([])
    (tmp_path / "folder.npz").mkdir()
    for output in (tmp_path / "rays.txt", tmp_path / "folder.npz"):
        with pytest.raises(NergError, match=output.name):
            import_rays("absent.csv", "varjo", output=output)


# ---- Datasets: import and reports, as for files ----


@pytest.fixture
def parquet():
    pytest.importorskip("pyarrow", reason="datasets need the extra parquet")


@pytest.fixture
def files(tmp_path):
    return [write_source(tmp_path / "files" / f"{k}.csv", k, 200, start=DAY) for k in range(3)]


def import_dataset(files, output, **options):
    return import_rays(files, columns=MAP, output=output, **{"workers": 1, **options})


def test_files_are_imported_into_a_dataset(parquet, files, tmp_path):
    recorder, output = Recorder(), tmp_path / "shop.rays"
    rays = import_dataset(files, output, environment="shop", progress=recorder)
    assert_same(rays, import_rays(files, columns=MAP))
    assert recorder.messages[0] == "imported 3 sources, 597 rays" and "3 sources in" in recorder.messages[1]
    import_dataset(files, output, environment="shop", progress=recorder)
    assert recorder.messages[3] == "nothing to import; 3 unchanged"
    north = write_source(tmp_path / "north.csv", 5, 100)
    assert len(import_dataset(north, output, environment="north")) == 99 and len(RayDataset.open(output)) == 696
    assert [(report.title, report.summary.rays) for report in check_environments(output)] == [
        (f"{output}: north", 99),
        (f"{output}: shop", 597),
    ]
    assert [report.title for report in check_environments(output / "place=north")] == [str(output / "place=north")]


def test_an_environment_has_one_name(parquet, files, tmp_path):
    """A composed and a decomposed letter are equal."""
    output = tmp_path / "a.rays"
    for path, name in zip(files, ["Cafe\u0301", "Caf\u00e9"]):
        import_dataset(path, output, environment=name)
    assert RayDataset.open(output).places == ("Caf\u00e9",)
    assert len(RayDataset.open(output / "place=Cafe\u0301")) == len(RayDataset.open(output))


def test_failed_and_empty_sources_are_reported_at_the_end(parquet, files, tmp_path):
    files[1].write_text("t\n")
    files[2].write_text("t,p,x,y,z,a,b,c,q,h,i,j,g\n0,a,1,1,1,0,0,0,1,1,1,1,x\n")
    recorder = Recorder()
    with pytest.raises(NergError, match=r"1\.csv.*1 of 3 files could not be imported"):
        import_dataset(files, tmp_path / "shop.rays", progress=recorder)
    assert len(RayDataset.open(tmp_path / "shop.rays")) == 199
    (line,) = [line for line in recorder.messages if "gives a ray" in line]
    assert "2.csv" in line and "0.csv" not in line


def test_pseudonyms_of_datasets_match_those_of_files(parquet, files, salt, tmp_path):
    rays = import_dataset(files, tmp_path / "a.rays", pseudonyms=salt)
    assert rays.persons == import_rays(files, columns=MAP, pseudonyms=salt).persons
    random = import_dataset(files, tmp_path / "b.rays", pseudonyms="random")
    assert len(random.persons) == 9 and not set(random.persons) & set(rays.persons)
    with pytest.raises(NergError, match="random salt"):
        import_dataset(files, tmp_path / "b.rays", pseudonyms="random")


# ---- Proposals ----


def test_proposals_are_printed_with_their_files(tmp_path):
    for name, header in (("a", "t,x,y,z,dx,dy,dz"), ("b", "time,x,y,z,dx,dy,dz")):
        rows = "".join(f"{k / 50},{k},1.6,2,0,0,1\n" for k in range(30))
        (tmp_path / f"{name}.csv").write_text(f"{header}\n{rows}")
    recorder = Recorder()
    proposals = guess(tmp_path, progress=recorder)
    assert [p.paths[0].name for p in proposals] == ["a.csv", "b.csv"] and len(recorder.steps) == 1
    assert [m for m in recorder.messages if m.startswith("nerg rays import")] == [p.command for p in proposals]
    assert sum(line.strip().endswith((".csv", ".csv\n")) and line.strip() != "" for line in recorder.messages) >= 2
