"""Variants that work and that do not, and scenes that are loaded."""

import pytest

from nerg_mi import llvm
from nerg_mi.errors import NergError, UnusableLLVM
from nerg_mi.rendering.scene import activate, load_scene
from nerg_mi.workflows.render import sensor_of


def test_the_best_variant_that_works(rgb, monkeypatch):
    tried = []
    monkeypatch.setattr(rgb, "set_variant", tried.append)
    monkeypatch.setattr(llvm, "has_cuda", lambda: True)
    assert activate() == "cuda_ad_rgb" and activate("llvm_ad_mono") == "llvm_ad_mono"
    monkeypatch.setattr(llvm, "has_cuda", lambda: False)
    assert activate() == "llvm_ad_rgb" and tried == ["cuda_ad_rgb", "llvm_ad_mono", "llvm_ad_rgb"]


def test_a_backend_that_cannot_start_is_followed_by_the_next(rgb, monkeypatch):
    def only_llvm(name):
        if name.startswith("cuda"):
            raise ImportError("no device")

    monkeypatch.setattr(rgb, "set_variant", only_llvm)
    monkeypatch.setattr(llvm, "has_cuda", lambda: True)
    assert activate() == "llvm_ad_rgb"
    with pytest.raises(NergError, match='"cuda_ad_rgb"'):
        activate("cuda_ad_rgb")


def test_an_unusable_libllvm_is_told_as_such(rgb, monkeypatch):
    def refuse(name):
        raise UnusableLLVM("LLVM 15 cannot")

    monkeypatch.setattr(rgb, "set_variant", refuse)
    with pytest.raises(UnusableLLVM):
        activate()


def test_values_of_a_scene(rgb, tmp_path):
    (tmp_path / "s.xml").write_text(
        '<scene version="3.0.0"><default name="wide" value="6"/><sensor type="perspective"><film type="hdrfilm">'
        '<integer name="width" value="$wide"/></film></sensor></scene>'
    )
    width = lambda scene: scene.sensors()[0].film().size()[0]
    assert width(load_scene(tmp_path / "s.xml")) == 6 and width(load_scene(tmp_path / "s.xml", {"wide": "9"})) == 9
    with pytest.raises(NergError, match=r'asks for no "\$tall"'):
        load_scene(tmp_path / "s.xml", {"tall": "2"})


@pytest.mark.parametrize("name", ["path", "parallel", "optimize"])
def test_names_that_mitsuba_has_for_itself(rgb, tmp_path, name):
    file = tmp_path / "scene.xml"
    file.write_text(f'<scene version="3.0.0"><default name="{name}" value="1"/></scene>')
    with pytest.raises(NergError, match=f'"{name}" is a name that Mitsuba keeps .*scene.xml"'):
        load_scene(file, {name: "2"})


def test_a_scene_that_is_not_there(tmp_path):
    with pytest.raises(NergError, match="there is no scene file"):
        load_scene(tmp_path / "s.xml")


SCENE = '<scene version="3.0.0">{}</scene>'
SCALED = '<shape type="{}"><transform name="to_world"><scale value="{}"/></transform></shape>'


@pytest.mark.parametrize(
    "inside, said",
    [
        *[(f'<shape type="sphere"><float name="radius" value="{r}"/></shape>', "Sphere") for r in ("nan", "inf", 1e38)],
        *[(SCALED.format("cube", scale), "Mesh|Cube") for scale in ("nan", 1.1e7, -1e200)],
        (SCALED.format("disk", "inf"), "corners of the Disk"),
        (SCALED.format("cube", 1) + SCALED.format("cube", 1e9), "corners"),  # which Mitsuba makes one mesh of
        (
            '<sensor type="perspective"><transform name="to_world"><translate x="1e30"/></transform></sensor>',
            "the to_world of sensor 0",
        ),
    ],
)
def test_shapes_and_sensors_beyond_all_places(rgb, tmp_path, inside, said):
    (tmp_path / "s.xml").write_text(SCENE.format(inside))
    with pytest.raises(NergError, match=f"({said}).* must have coordinates from"):
        load_scene(tmp_path / "s.xml")


def test_shapes_as_large_as_can_be_are_taken(rgb, tmp_path):
    (tmp_path / "s.xml").write_text(SCENE.format(SCALED.format("cube", 9.9e6) + SCALED.format("sphere", 1e-6)))
    assert len(load_scene(tmp_path / "s.xml").shapes()) == 2


def test_a_picture_needs_an_integrator(rgb, tmp_path):
    (tmp_path / "s.xml").write_text(SCENE.format('<sensor type="perspective"/>'))
    with pytest.raises(NergError, match="s.xml"):
        sensor_of(tmp_path / "s.xml", load_scene(tmp_path / "s.xml"), 0)
