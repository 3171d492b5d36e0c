"""The names at the top of the package: few, typed, imported when they are used, each with an example that runs."""

import doctest
import inspect
import subprocess
import sys
from importlib.resources import files

import pytest

import nerg_mi as nerg

HEAVY = {"numpy", "mitsuba", "drjit", "scipy", "matplotlib", "safetensors", "torch", "trimesh", "rich", "typer"}


def run(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test01_there_are_few_and_dir_shows_them():
    assert len(nerg.__all__) <= 20 and nerg.__all__ == sorted(nerg.__all__)
    assert set(nerg.__all__) == set(nerg._WHERE)
    assert set(nerg.__all__) <= set(dir(nerg))
    assert not [name for name in dir(nerg) if not name.startswith("__") and name not in nerg.__all__]


def test02_importing_loads_nothing_heavy_and_no_module_of_the_api():
    loaded = run("import nerg_mi as nerg, sys; dir(nerg); nerg.__version__; print(*sys.modules)").split()
    assert not HEAVY & set(loaded)
    ours = {name for name in loaded if name.startswith("nerg_mi")}
    assert ours == {f"nerg_mi{part}" for part in ("", ".errors", ".llvm", ".registration")}


def test03_a_name_loads_its_module_and_not_the_others():
    loaded = run("import nerg_mi as nerg, sys; nerg.Camera; print(*sys.modules)").split()
    assert "nerg_mi.api.arrays" in loaded
    assert not {"nerg_mi.api.scene", "nerg_mi.api.workflows", "mitsuba", "matplotlib"} & set(loaded)


def test04_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match='"nerg_mi".*"rendre"') as error:
        nerg.rendre  # noqa: B018
    # With these Python suggests a name.
    assert (error.value.name, error.value.obj) == ("rendre", nerg)


@pytest.mark.parametrize("name", nerg.__all__)
def test05_types_are_known(name):
    value = getattr(nerg, name)
    assert value.__doc__ and value.__name__ == name
    if inspect.isfunction(value):
        signature = inspect.signature(value)
        assert signature.return_annotation is not inspect.Signature.empty
        assert all(p.annotation is not inspect.Parameter.empty for p in signature.parameters.values())


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """A folder of posed photos: the store, rendered from four places."""
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
    about = {"camera_angle_x": float(np.radians(70)), "w": 24, "h": 16, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(about))
    return folder


@pytest.fixture(scope="module")
def rays():
    """Somebody who stands about and looks around."""
    import numpy as np

    rng = np.random.default_rng(0)
    n = 6000
    origin = rng.uniform((1, 1, 1.5), (3.4, 3.4, 1.6), (n, 3))
    direction = rng.normal(size=(n, 3)) * (1, 1, 0.2)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    who = np.arange(n) % 2
    return nerg.Rays(np.arange(n) / 30, who, ("Ada", "Bob"), origin, direction, np.ones(n))


# Each of them trains, or measures, for seconds, which quicker tests of its job do with less.
LONG = {"ablate", "study", "train_radiance"}


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.nightly] * (n in LONG)) for n in nerg.__all__])
def test07_examples_run(name, tmp_path, request):
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
