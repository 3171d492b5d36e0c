"""Neural radiance and gaze fields for Mitsuba 3.

    import nerg_mi as nerg

    scene = nerg.make_scene("store.safetensors", "shoppers.safetensors", camera=nerg.Camera((7, 3, 2), (5, 4, 1)))
    pictures = nerg.render(scene, observers=[(4.4, 2.8, 1.6)])

`docs/reference/python.md` introduces the interface; each name of `__all__` has an example in its docstring. A Mitsuba
variant that is already set is kept. Otherwise the first call that needs a variant sets ``cuda_ad_rgb`` if it works, and
``llvm_ad_rgb`` if not.

Importing this package makes its plugins available to Mitsuba: before or after `import mitsuba`, before or after
`mi.set_variant`, and after each change of variant. The import is cheap: it loads neither Mitsuba nor NumPy, and each
name of the API is loaded on first use.

If Dr.Jit would load a libLLVM on which it aborts the process, importing Dr.Jit or Mitsuba after this package raises
`nerg_mi.errors.UnusableLLVM`, an `ImportError`. If Dr.Jit is already loaded, importing this package raises it.
Everything else works without LLVM, including the command `nerg doctor`.
"""

from pathlib import Path as _Path
from typing import TYPE_CHECKING

from . import llvm as _llvm
from . import registration as _registration

if TYPE_CHECKING:
    from .alignment.align import align
    from .api.analysis import bake, draw, export_scene, render_film, report, statistics, write_scene
    from .api.arrays import Camera
    from .api.evaluation import evaluate_gaze, evaluate_radiance, folds, next_look, study
    from .api.gaze import load_gaze
    from .api.query import attention, observe, trace
    from .api.recordings import check_rays, filter_rays, guess, import_rays, plot_rays, split_rays
    from .api.render import render
    from .api.scene import Scene, make_scene
    from .api.training import train_gaze, train_prior, train_radiance
    from .environment.contents import DensityGrid
    from .environment.conversion import (
        export_mesh,
        export_points,
        export_splats,
        export_torch_ngp,
        export_volume,
        import_checkpoint,
    )
    from .environment.trained import load_field
    from .errors import NergError
    from .rays.dataset import load_rays
    from .rays.rays import Rays
    from .rays.readers.registry import register_reader
    from .train.compile import compile_field
    from .train.gaze_recipes import register_recipe
    from .train.poses import find_poses
    from .train.refine import refine_field
    from .transport.quadrature import register_quadrature
    from .viewer.serve import view

__version__ = "0.1.0"

_MODULES = {
    "Camera": "nerg_mi.api.arrays",
    "DensityGrid": "nerg_mi.environment.contents",
    "NergError": "nerg_mi.errors",
    "Rays": "nerg_mi.rays.rays",
    "Scene": "nerg_mi.api.scene",
    "align": "nerg_mi.alignment.align",
    "attention": "nerg_mi.api.query",
    "bake": "nerg_mi.api.analysis",
    "check_rays": "nerg_mi.api.recordings",
    "compile_field": "nerg_mi.train.compile",
    "draw": "nerg_mi.api.analysis",
    "evaluate_gaze": "nerg_mi.api.evaluation",
    "evaluate_radiance": "nerg_mi.api.evaluation",
    "export_mesh": "nerg_mi.environment.conversion",
    "export_points": "nerg_mi.environment.conversion",
    "export_scene": "nerg_mi.api.analysis",
    "export_splats": "nerg_mi.environment.conversion",
    "export_torch_ngp": "nerg_mi.environment.conversion",
    "export_volume": "nerg_mi.environment.conversion",
    "filter_rays": "nerg_mi.api.recordings",
    "find_poses": "nerg_mi.train.poses",
    "folds": "nerg_mi.api.evaluation",
    "guess": "nerg_mi.api.recordings",
    "import_checkpoint": "nerg_mi.environment.conversion",
    "import_rays": "nerg_mi.api.recordings",
    "load_field": "nerg_mi.environment.trained",
    "load_gaze": "nerg_mi.api.gaze",
    "load_rays": "nerg_mi.rays.dataset",
    "make_scene": "nerg_mi.api.scene",
    "next_look": "nerg_mi.api.evaluation",
    "observe": "nerg_mi.api.query",
    "plot_rays": "nerg_mi.api.recordings",
    "refine_field": "nerg_mi.train.refine",
    "register_quadrature": "nerg_mi.transport.quadrature",
    "register_reader": "nerg_mi.rays.readers.registry",
    "register_recipe": "nerg_mi.train.gaze_recipes",
    "render": "nerg_mi.api.render",
    "render_film": "nerg_mi.api.analysis",
    "report": "nerg_mi.api.analysis",
    "split_rays": "nerg_mi.api.recordings",
    "statistics": "nerg_mi.api.analysis",
    "study": "nerg_mi.api.evaluation",
    "trace": "nerg_mi.api.query",
    "train_gaze": "nerg_mi.api.training",
    "train_prior": "nerg_mi.api.training",
    "train_radiance": "nerg_mi.api.training",
    "view": "nerg_mi.viewer.serve",
    "write_scene": "nerg_mi.api.analysis",
}
"""The public names, and the module that defines each."""

__all__ = [
    "Camera",
    "DensityGrid",
    "NergError",
    "Rays",
    "Scene",
    "align",
    "attention",
    "bake",
    "check_rays",
    "compile_field",
    "draw",
    "evaluate_gaze",
    "evaluate_radiance",
    "export_mesh",
    "export_points",
    "export_scene",
    "export_splats",
    "export_torch_ngp",
    "export_volume",
    "filter_rays",
    "find_poses",
    "folds",
    "guess",
    "import_checkpoint",
    "import_rays",
    "load_field",
    "load_gaze",
    "load_rays",
    "make_scene",
    "next_look",
    "observe",
    "plot_rays",
    "refine_field",
    "register_quadrature",
    "register_reader",
    "register_recipe",
    "render",
    "render_film",
    "report",
    "split_rays",
    "statistics",
    "study",
    "trace",
    "train_gaze",
    "train_prior",
    "train_radiance",
    "view",
    "write_scene",
]


def __getattr__(name: str) -> object:
    """Import the module of a public name on first access."""
    if name not in _MODULES:
        import sys

        raise AttributeError(f'module "{__name__}" has no attribute "{name}"', name=name, obj=sys.modules[__name__])
    from importlib import import_module

    value = getattr(import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, "__version__", *(name for name in globals() if name.startswith("__"))})


_root = _Path(__file__).resolve().parents[1]
if not (_root / "nerg_mi" / "plugins").is_dir() and (_root / "plugins" / "__init__.py").is_file():
    # In a checkout, the plugins and the scenes are next to the package; an installation contains them.
    __path__.append(str(_root))
_llvm.select_library()
_registration.install()
