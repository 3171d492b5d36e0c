"""The table of AOVs: one entry is all that an AOV is."""

import sys
from pathlib import Path

import drjit as dr
import numpy as np
import pytest

from nerg_mi.api.scene import Scene
from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import find_overlay, to_bytes
from nerg_mi.files.images import write_exr
from nerg_mi.transport import aovs
from nerg_mi.viewer.layers import automatic, available, colored, legend, usual_scale
from nerg_mi.workflows.draw import draw
from nerg_mi.workflows.render import layers_of

from .scenes import camera, channels, constant, named, with_field, with_gaze
from .test_nerg_leaves_out import operations


@pytest.fixture
def table(rgb):
    """The table, for a test to add to."""
    before = dict(aovs.AOVS)
    yield aovs
    aovs.AOVS.clear()
    aovs.AOVS.update(before)


def test01_an_entry_is_all_that_an_aov_is(rgb, files, table):
    entry = table.Aov(
        name="height",
        channels="ZT",
        summary="of the surface above the plane z = -1, and the distance to it",
        compute=lambda p: [dr.select(p.surface, p.p_d.z + 1, 0), p.depth],
        needs=(table.FIELD,),
    )
    table.AOVS["height"] = entry
    integrator = with_field(files, aovs="position,height,depth")
    out = channels(rgb, integrator)
    assert list(out)[3:5] == ["height.Z", "height.T"]
    met = out["position.Z"] != 0
    assert met.sum() > 20
    np.testing.assert_allclose(out["height.Z"][met], out["position.Z"][met] + 1, rtol=1e-5)
    assert not out["height.Z"][~met].any() and np.array_equal(out["height.T"], out["depth.T"])
    with pytest.raises(RuntimeError, match='"aovs".*"height".*"field"'):
        rgb.load_dict(constant(aovs="height"))
    assert "- ``height`` (``.Z .T``): of the surface above the plane" in table.manual()


def test02_the_manual_lists_the_table(rgb, table):
    rgb.load_dict(constant())
    manual = sys.modules["nerg_mi.plugins.nerg"].NergIntegrator.__doc__
    assert table.manual() in manual and not any(w in manual for w in ("{aovs}", "{depths}", "{quadratures}"))
    for name, aov in table.AOVS.items():
        assert f"- ``{name}`` (" in manual and name == aov.name
    assert max(len(line) for line in table.manual().splitlines()) <= 120


def test03_every_aov_renders(rgb, files, table, tmp_path):
    """All that need nothing but a field and a gaze field, at once, with as many channels as they are said to have."""
    given = rgb.load_dict(with_gaze(files))
    names = [n for n, aov in table.AOVS.items() if all(need.is_met(given) for need in aov.needs)]
    assert {"features", "gaze", "density_evals"} < set(names) and "gaze_std" not in names
    integrator = with_gaze(files, ",".join(names))
    scene = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": camera(rgb)})
    out = named(rgb, np.array(rgb.render(scene, spp=1)), integrator)
    assert all(np.isfinite(v).all() and v.any() for v in out.values()), [k for k, v in out.items() if not v.any()]
    # Each alone is what it is beside the others.
    for name in names:
        alone = channels(rgb, {**integrator, "aovs": name})
        for channel, value in alone.items():
            if not name.endswith("density_evals"):
                np.testing.assert_allclose(value, out[channel], rtol=1e-5, atol=1e-6, err_msg=channel)


def test04_what_is_not_asked_for_is_not_computed(rgb, files, table):
    """An entry costs nothing until its name is asked for."""
    plain = operations(rgb, with_gaze(files, "depth"))
    calls = []
    table.AOVS["costly"] = table.Aov(
        name="costly",
        summary="many operations",
        compute=lambda p: (calls.append(p), [sum(dr.sin(p.depth * k) for k in range(400))])[1],
        demands=frozenset({"counts", "features"}),
    )
    assert operations(rgb, with_gaze(files, "depth")) == plain and not calls
    assert operations(rgb, with_gaze(files, "depth,costly")) > plain + 400 and calls


@pytest.mark.parametrize("kind", ["sequential", "heat", "diverging", "categorical", "shade"])
def test05_an_entry_is_shown_everywhere(rgb, table, tmp_path, kind):
    """With its title, scale and unit, without another file that names it."""
    table.AOVS["rows"] = table.Aov(
        name="rows",
        title="Shelf row",
        label="row of the shelf",
        unit="rows",
        display=table.Display(kind=kind),
        summary="number of the row in which the surface lies",
        compute=lambda p: [dr.select(p.surface, dr.floor(p.p_d.z * 2 + 3), 0)],
    )
    scene = rgb.load_dict({"type": "scene", "integrator": constant(), "sensor": camera(rgb)})
    # Overlays, with the title, the label and the unit of the table.
    overlay = find_overlay("rows")
    layers = layers_of(Path("scene.xml"), scene, scene.sensors()[0], overlay)
    assert set(np.unique(layers.values[layers.mask])) <= set(range(9)) and layers.values.any()
    limits = overlay.limits(layers)
    if kind == "diverging":
        assert limits[0] == -limits[1]
    assert (limits is None) == (kind == "categorical")
    said = [axes.get_ylabel().replace("\n", " ") for axes in overlay.draw(layers, limits).axes]
    assert "row of the shelf [rows]" in said
    # The viewer, with the same colours.
    (layer,) = [la for la in available(Scene(scene)) if la.title == "shelf row"]
    scale = usual_scale(layer, automatic(layer, layers.values, layers.mask), None)
    shown = colored(layer, layers.color, layers.values, layers.mask, scale, hatched=False)
    assert np.array_equal(shown[layers.mask], to_bytes(overlay.paint(layers, limits))[layers.mask])
    assert ("rows" if kind not in ("shade", "categorical") else "row of the shelf") in legend(layer, scale)
    # Files: sheets and differences.
    file = tmp_path / "a.exr"
    write_exr(file, {"rows.Y": layers.values, "opacity.Y": layers.mask.astype(np.float32)})
    said = [axes.get_ylabel().replace("\n", " ") for axes in draw("sheet", [file], overlay="rows").axes]
    assert "row of the shelf [rows]" in said
    if kind == "categorical":
        with pytest.raises(NergError, match='"rows" names classes'):
            draw("difference", [file, file], channel="rows")
    else:
        said = [axes.get_ylabel() for axes in draw("difference", [file, file], channel="rows").axes]
        assert any("difference of rows [rows]" in text.replace("\n", " ") for text in said)
