"""Public names of the package, the variant they select, and arrays and cameras."""

from __future__ import annotations

import doctest
import importlib
import inspect
import re
import subprocess
import sys
from dataclasses import is_dataclass
from importlib.resources import files
from typing import get_type_hints

import numpy as np
import pytest

import nerg_mi as nerg

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
    assert "nerg_mi.environment.arrays" in loaded
    assert not {"nerg_mi.environment.scene", "nerg_mi.environment.scene_file", "mitsuba", "matplotlib"} & set(loaded)


def test04_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match='"nerg_mi".*"rendre"') as error:
        nerg.rendre  # noqa: B018
    # Python uses these to suggest a name.
    assert (error.value.name, error.value.obj) == ("rendre", nerg)


@pytest.mark.parametrize("name", nerg.__all__)
def test05_types_are_resolved(name):
    value = getattr(nerg, name)
    assert value.__doc__ and value.__name__ == name
    get_type_hints(value)
    for kind in value.__mro__[:-1] if inspect.isclass(value) else ():
        for method in (m for n, m in vars(kind).items() if not n.startswith("_")):
            function = getattr(method, "__func__", getattr(method, "fget", method))
            if inspect.isfunction(function):
                get_type_hints(function)
    if inspect.isfunction(value):
        signature = inspect.signature(value)
        assert signature.return_annotation is not inspect.Signature.empty
        assert all(p.annotation is not inspect.Parameter.empty for p in signature.parameters.values())


def list_objects() -> dict[str, type]:
    """The public classes, and those that public functions return, by name."""
    listed = {}
    for name in nerg.__all__:
        value = getattr(nerg, name)
        if inspect.isclass(value):
            listed[name] = value
        elif not name.startswith("register_"):
            kinds = set(re.findall(r"[A-Z]\w+", str(value.__annotations__["return"]))) - {"Figure", "Path", "Tensor"}
            listed |= {kind: getattr(sys.modules[value.__module__], kind) for kind in kinds}
    return {name: kind for name, kind in listed.items() if not issubclass(kind, Exception)}


def names_with(*methods: str) -> set[str]:
    """The names of the objects with one of these methods, of their own or of a base class of this package."""
    return {
        name
        for name, kind in list_objects().items()
        if any(method in vars(c) for method in methods for c in kind.__mro__ if c not in (object, tuple))
    }


def test_objects_and_results_have_the_same_methods():
    """Representations in consoles and notebooks of each, and files and tables of what is one."""
    kinds = list_objects()
    assert names_with("_repr_html_") == names_with("__repr__") == set(kinds) and len(kinds) > 35
    # That of a dataclass would list all values; the one of a camera is the call that makes it.
    assert {n for n, kind in kinds.items() if is_dataclass(kind) and kind.__dataclass_params__.repr} == {"Camera"}
    files = {"Alignment", "Areas", "DensityGrid", "Environment", "GazeField", "RadianceField", "Rays", "Scene"}
    assert names_with("load", "open") == files | {"Photos", "RayDataset", "WrittenScene"}
    # Others are in memory only, or written by the function that returns them.
    results = {"Bake", "SplatBake", "ImportedFields", "MeasuredEvents", "RaysSplit", "Report", "StatisticsResult"}
    results |= {"StudyResult", "Surface", "SurfaceSplats", "TorchNgpModel", "FoldResult", "GazeEvaluation"}
    results |= {"NextLookEvaluation", "ViewScores", "RobustnessResult", "AreaGaze"}
    assert names_with("save") == files | results
    tables = {"Areas", "Attention", "FoldResult", "GazeEvaluation", "MeasuredEvents", "NextLookEvaluation", "Photos"}
    assert names_with("to_dataframe") == tables | {
        "AreaGaze",
        "Rays",
        "RobustnessResult",
        "StatisticsResult",
        "StudyResult",
        "ViewScores",
    }


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """A folder of posed photos: the store, rendered from four positions."""
    import json

    import mitsuba as mi

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

    rng = np.random.default_rng(0)
    n = 6000
    origin = rng.uniform((1, 1, 1.5), (3.4, 3.4, 1.6), (n, 3))
    direction = rng.normal(size=(n, 3)) * (1, 1, 0.2)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    who = np.arange(n) % 2
    return nerg.Rays(np.arange(n) / 30, who, ("Ada", "Bob"), origin, direction, np.ones(n))


# These examples train or measure for seconds; faster tests of the same workflows exist.
LONG = {
    "bake",
    "compile_field",
    "evaluate_gaze",
    "folds",
    "next_look",
    "refine_field",
    "report",
    "study",
    "train_radiance",
}

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
        ("nerg_mi.tracking.rays", "Rays", "from_arrays from_dataframe to_dataframe"),
        ("nerg_mi.environment.scene", "Scene", "save show"),
        ("nerg_mi.environment.gaze", "GazeField", "density score sample regions"),
        ("nerg_mi.figures.pictures", "Pictures", "plot"),
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
