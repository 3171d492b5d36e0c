"""Public names of the package, the variant they select, and arrays and cameras."""

from __future__ import annotations

import copy
import doctest
import importlib
import inspect
import pickle
import subprocess
import sys
from importlib.resources import files

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.api.arrays import LabelledArrays, as_points, as_unit_vectors, broadcast_to_observers
from nerg_mi.errors import NergError
from nerg_mi.rendering.scene import activate_mitsuba, get_array_module

# ---- The names at the top of the package ----


HEAVY = {"numpy", "mitsuba", "drjit", "scipy", "matplotlib", "safetensors", "torch", "trimesh", "rich", "typer"}


def run(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test01_dir_lists_public_names():
    assert nerg.__all__ == sorted(nerg.__all__)
    assert set(nerg.__all__) == set(nerg._MODULES)
    assert set(nerg.__all__) <= set(dir(nerg))
    assert not [name for name in dir(nerg) if not name.startswith("__") and name not in nerg.__all__]


def test02_importing_loads_nothing_heavy_and_no_module_of_the_api():
    loaded = run("import nerg_mi as nerg, sys; dir(nerg); nerg.__version__; print(*sys.modules)").split()
    assert not HEAVY & set(loaded)
    ours = {name for name in loaded if name.startswith("nerg_mi")}
    assert ours == {f"nerg_mi{part}" for part in ("", ".errors", ".llvm", ".memory", ".registration")}


def test03_a_name_loads_its_module_and_not_the_others():
    loaded = run("import nerg_mi as nerg, sys; nerg.Camera; print(*sys.modules)").split()
    assert "nerg_mi.api.arrays" in loaded
    assert not {"nerg_mi.api.scene", "nerg_mi.api.analysis", "mitsuba", "matplotlib"} & set(loaded)


def test04_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match='"nerg_mi".*"rendre"') as error:
        nerg.rendre  # noqa: B018
    # Python uses these to suggest a name.
    assert (error.value.name, error.value.obj) == ("rendre", nerg)


@pytest.mark.parametrize("name", nerg.__all__)
def test05_types_are_resolved(name):
    value = getattr(nerg, name)
    assert value.__doc__ and value.__name__ == name
    if inspect.isfunction(value):
        signature = inspect.signature(value)
        assert signature.return_annotation is not inspect.Signature.empty
        assert all(p.annotation is not inspect.Parameter.empty for p in signature.parameters.values())


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """A folder of posed photos: the store, rendered from four positions."""
    import json

    import mitsuba as mi
    import numpy as np

    folder = tmp_path_factory.mktemp("photos")
    scene = nerg.make_scene(files("nerg_mi.scenes.store") / "store.safetensors")
    frames = []
    for i, eye in enumerate([(4.4, 2.8, 1.6), (4.4, 3.4, 1.6), (4.5, 2.2, 1.5), (4.5, 4.0, 1.5)]):
        camera = nerg.Camera(eye, (4.8, 4.9, 1.2), fov=70, width=24, height=16)
        color = nerg.render(scene, quantities="color", camera=camera, spp=16).color[0]
        mi.util.write_bitmap(str(folder / f"{i}.png"), mi.TensorXf(np.ascontiguousarray(color)), write_async=False)
        pose = np.array(mi.ScalarTransform4f().look_at(list(camera.origin), list(camera.target), [0, 0, 1]).matrix)
        # Mitsuba's cameras look along +z with x to the left, those of transforms.json along -z with x to the right.
        frames.append({"file_path": f"{i}.png", "transform_matrix": (pose @ np.diag([-1, 1, -1, 1])).tolist()})
    provenance = {"camera_angle_x": float(np.radians(70)), "w": 24, "h": 16, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(provenance))
    return folder


@pytest.fixture(scope="module")
def rays():
    """A participant who moves and looks around."""
    import numpy as np

    rng = np.random.default_rng(0)
    n = 6000
    origin = rng.uniform((1, 1, 1.5), (3.4, 3.4, 1.6), (n, 3))
    direction = rng.normal(size=(n, 3)) * (1, 1, 0.2)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    who = np.arange(n) % 2
    return nerg.Rays(np.arange(n) / 30, who, ("Ada", "Bob"), origin, direction, np.ones(n))


# These examples train or measure for seconds; faster tests of the same workflows exist.
LONG = {"folds", "next_look", "report", "study", "train_radiance"}

# Modules that an example needs, and the extras that install them.
EXTRAS = {
    "export_mesh": ("skimage", "mesh"),
    "export_scene": ("pxr", "usd"),
    "find_poses": ("pycolmap", "poses"),
    "view": ("viser", "viewer"),
}


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.nightly] * (n in LONG)) for n in nerg.__all__])
def test07_examples_run(name, tmp_path, request):
    if name in EXTRAS:
        module, extra = EXTRAS[name]
        pytest.importorskip(module, reason=f"{module}, of the extra {extra}, is not installed")
    value = getattr(nerg, name)
    (test,) = doctest.DocTestFinder(recurse=False).find(value, name, globs={"folder": tmp_path})
    assert test.examples, f"the docstring of {name} has no example"
    source = "".join(example.source for example in test.examples)
    for need in ("photos", "rays"):
        if f"({need}" in source or f" {need}," in source:
            test.globs[need] = request.getfixturevalue(need)
    said = []
    results = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(test, out=said.append)
    assert results.failed == 0, "".join(said)


METHODS = [
    f"{module}.{kind}.{method}"
    for module, kind, methods in (
        ("nerg_mi.rays.rays", "Rays", "from_arrays from_dataframe to_dataframe filter"),
        ("nerg_mi.api.scene", "Scene", "save show"),
        ("nerg_mi.api.gaze", "TrainedGazeField", "density score sample regions"),
        ("nerg_mi.api.render", "Pictures", "plot"),
    )
    for method in methods.split()
]


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS, ids=lambda name: ".".join(name.split(".")[-2:]))
def test08_examples_of_methods_run(name, tmp_path):
    module, kind, method = name.rsplit(".", 2)
    function = getattr(getattr(importlib.import_module(module), kind), method)
    (test,) = doctest.DocTestFinder(recurse=False).find(function, name, globs={"folder": tmp_path})
    said = []
    results = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(test, out=said.append)
    assert test.examples and results.failed == 0, "".join(said)


# ---- The API uses the active variant, and sets one only if there is none ----


def test01_default_variant_is_set():
    code = "import nerg_mi as nerg, mitsuba as mi; nerg.Scene; print(mi.variant()); "
    code += "from nerg_mi.rendering.scene import activate_mitsuba; print(activate_mitsuba().variant())"
    before, after = run(code).split()
    assert before == "None" and after in ("cuda_ad_rgb", "llvm_ad_rgb")


def test02_active_variant_is_kept(mono):
    assert activate_mitsuba() is mono and mono.variant() == "llvm_ad_mono"
    assert get_array_module().__name__ == "drjit.llvm.ad"
    assert mono.variant() == "llvm_ad_mono"


def test03_scalar_variants_are_refused(rgb):
    rgb.set_variant("scalar_rgb")
    with pytest.raises(NergError, match='"scalar_rgb".*mi.set_variant'):
        activate_mitsuba()


# ---- Conversion from and to NumPy ----


def test01_points_of_every_shape():
    assert as_points((1, 2, 3), "x").shape == (1, 3)
    assert as_points([[1, 2, 3], [4, 5, 6]], "x").dtype == np.float32
    assert as_points(np.ones((5, 3), int)[::2], "x").flags.c_contiguous


@pytest.mark.parametrize(
    "wrong, said",
    [
        ((1, 2), r"eyes must have the shape \(3,\) or \(N, 3\), got \(2,\)"),
        (np.zeros((0, 3)), r"shape .* got \(0, 3\)"),
        ("here", "eyes must be x, y, z"),
        ([(0, 0, 0), (0, np.nan, 0)], r"row 1 is \[0.0, nan, 0.0\]"),
        ([(0, 0, 0), (0, 0, 1.1e7)], "coordinates from -1e.07 to 1e.07, but row 1"),
        ((1e308, 0, 0), "row 0 is"),
        ((10**400, 0, 0), "eyes must have coordinates from"),
        ([(0, 0), (0, 0, 1)], "eyes must be x, y, z"),
    ],
)
def test02_errors_name_the_invalid_points(wrong, said):
    with pytest.raises(NergError, match=said):
        as_points(wrong, "eyes")


def test03_directions_are_normalised_and_broadcast():
    d = as_unit_vectors((0, 3, 4), 5, "d")
    assert d.shape == (5, 3) and np.allclose(d, (0, 0.6, 0.8))
    with pytest.raises(NergError, match="d must not be zero, but row 1 is"):
        as_unit_vectors([(1, 0, 0), (0, 0, 0)], 2, "d")
    with pytest.raises(NergError, match=r"that of the origins \(3\), got 2"):
        as_unit_vectors([(1, 0, 0), (0, 1, 0)], 3, "d")


def make():
    depth = broadcast_to_observers(np.arange(6, dtype=np.float32).reshape(2, 3), 4)
    color = np.zeros((4, 2, 3, 3), np.float32)
    return LabelledArrays({"depth": depth, "color": color}, ("observer", "row", "column"), np.zeros((4, 3), np.float32))


def test04_arrays_have_names():
    result = make()
    assert result.names == ("depth", "color") and list(result) == ["depth", "color"] and len(result) == 2
    assert result.depth is result["depth"] and "color" in result and "gaze" not in result
    assert "depth" in dir(result)
    assert repr(result).splitlines() == [
        "LabelledArrays(observer 4, row 2, column 3)",
        "  depth  (4, 2, 3), float32",
        "  color  (4, 2, 3, 3), float32",
    ]


def test05_missing_arrays_are_errors():
    with pytest.raises(KeyError, match='"gaze"'):
        make()["gaze"]
    with pytest.raises(AttributeError, match='has no "gaze"'):
        make().gaze  # noqa: B018


def test06_broadcast_arrays_are_read_only():
    with pytest.raises(ValueError):
        make().depth[0, 0, 0] = 1


def test07_copies():
    result = make()
    assert np.array_equal(copy.copy(result).depth, result.depth)
    assert np.array_equal(pickle.loads(pickle.dumps(result)).color, result.color)


# ---- Cameras from a few numbers, and refused values ----


def test01_the_middle_of_the_picture_is_the_target(rgb):
    camera = nerg.Camera(origin=(1, 2, 3), target=(4, 6, 3), up=(0, 0, 1), fov=40, width=64, height=32)
    sensor = rgb.load_dict(camera.to_dict(4))
    ray, _ = sensor.sample_ray(0, 0, (0.5, 0.5), (0.5, 0.5))
    assert np.allclose(np.ravel(ray.d), (0.6, 0.8, 0), atol=1e-6)
    assert np.allclose(np.ravel(sensor.world_transform() @ rgb.Point3f(0)), (1, 2, 3))
    assert tuple(sensor.film().size()) == (64, 32) and sensor.sampler().sample_count() == 4
    assert sensor.film().rfilter().is_box_filter()


def test02_fov_is_that_of_the_width_and_up_is_up(rgb):
    sensor = rgb.load_dict(nerg.Camera((0, 0, 0), (0, 1, 0), fov=90, width=20, height=10).to_dict())
    left, right, top = (np.ravel(sensor.sample_ray(0, 0, at, (0.5, 0.5))[0].d) for at in ((0, 0.5), (1, 0.5), (0.5, 0)))
    assert np.isclose(np.dot(left, right), 0, atol=1e-6)
    assert right[0] > 0 > left[0] and top[2] > 0


@pytest.mark.parametrize(
    "wrong, said",
    [
        ({"target": (1, 2, 3)}, "must differ from its origin"),
        ({"target": (1, 2, 8)}, "must not be parallel"),
        ({"up": (0, 0, 0)}, "must not be parallel"),
        ({"fov": 180}, "must lie in 0.0001 .. 179.9, got 180"),
        ({"fov": float("nan")}, "got nan"),
        ({"width": 0}, "the width of a picture must lie in 1 .. "),
        ({"height": 2.5}, "must be a whole number, got 2.5"),
        ({"width": 1 << 20, "height": 1 << 20}, "at most 268,435,456 pixels"),
        ({"origin": (0, float("inf"), 0)}, "origin of a camera"),
        ({"origin": (0, 1)}, "origin of a camera must"),
        ({"origin": [(0, 1, 2)]}, "origin of a camera"),
    ],
)
def test03_invalid_cameras_are_refused(wrong, said):
    with pytest.raises(nerg.NergError, match=said):
        nerg.Camera(**{"origin": (1, 2, 3), "target": (4, 5, 6), **wrong})
