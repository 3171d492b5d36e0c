"""Neural radiance and gaze fields for Mitsuba 3.

    import nerg_mi as nerg

    scene = nerg.make_scene("store.safetensors", "shoppers.safetensors", camera=nerg.Camera((7, 3, 2), (5, 4, 1)))
    pictures = nerg.render(scene, observers=[(4.4, 2.8, 1.6)])

docs/how-to/python.md introduces the interface; each name of `__all__` has an example in its docstring. A Mitsuba
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
    from .aoi.areas import Areas
    from .aoi.attention import attention
    from .aoi.bids import export_rays
    from .aoi.flat import draw_area
    from .aoi.robustness import robustness
    from .aoi.statistics import statistics
    from .environment.arrays import Camera
    from .environment.contents import DensityGrid
    from .environment.conversion import (
        export_mesh,
        export_points,
        export_splats,
        export_torch_ngp,
        export_volume,
        import_checkpoint,
    )
    from .environment.environment import Environment
    from .environment.gaze import GazeField
    from .environment.queries import observe, trace
    from .environment.radiance import RadianceField
    from .environment.scene import Scene, make_scene
    from .environment.scene_file import write_scene
    from .environment.tensors import render_tensor
    from .errors import NergError
    from .evaluation.folds import folds
    from .evaluation.held_out import evaluate_gaze
    from .evaluation.next_look_scores import next_look
    from .evaluation.photos import evaluate_radiance
    from .evaluation.study_run import study
    from .figures.films import render_film
    from .figures.floor_plans import draw_floor, plot_rays
    from .figures.image_files import draw_difference, draw_sheet
    from .figures.occlusion import draw_sphere, draw_triptych
    from .figures.pictures import render
    from .figures.scanpath import draw_scanpath
    from .formats.alignments import Alignment
    from .interop.scenes import export_scene
    from .photos.photo_set import Photos
    from .reports.report import report
    from .surfaces.bake import bake
    from .surfaces.baked import draw_surface
    from .tracking.imports import guess, import_rays
    from .tracking.measurement import measure_events
    from .tracking.quality import check_rays
    from .tracking.rays import Rays
    from .tracking.readers.registry import register_reader
    from .tracking.selection import filter_rays
    from .tracking.splits import split_rays
    from .train.compile import compile_field, refine_field
    from .train.gaze import train_gaze
    from .train.gaze_recipes import register_recipe
    from .train.poses import find_poses
    from .train.prior import train_prior
    from .train.radiance import train_radiance
    from .transport.quadrature import register_quadrature
    from .viewer.serve import view

__version__ = "0.1.0"

_MODULES = {
    "Alignment": "nerg_mi.formats.alignments",
    "Areas": "nerg_mi.aoi.areas",
    "Camera": "nerg_mi.environment.arrays",
    "DensityGrid": "nerg_mi.environment.contents",
    "Environment": "nerg_mi.environment.environment",
    "GazeField": "nerg_mi.environment.gaze",
    "NergError": "nerg_mi.errors",
    "Photos": "nerg_mi.photos.photo_set",
    "RadianceField": "nerg_mi.environment.radiance",
    "Rays": "nerg_mi.tracking.rays",
    "Scene": "nerg_mi.environment.scene",
    "align": "nerg_mi.alignment.align",
    "attention": "nerg_mi.aoi.attention",
    "bake": "nerg_mi.surfaces.bake",
    "check_rays": "nerg_mi.tracking.quality",
    "compile_field": "nerg_mi.train.compile",
    "draw_area": "nerg_mi.aoi.flat",
    "draw_difference": "nerg_mi.figures.image_files",
    "draw_floor": "nerg_mi.figures.floor_plans",
    "draw_scanpath": "nerg_mi.figures.scanpath",
    "draw_sheet": "nerg_mi.figures.image_files",
    "draw_sphere": "nerg_mi.figures.occlusion",
    "draw_surface": "nerg_mi.surfaces.baked",
    "draw_triptych": "nerg_mi.figures.occlusion",
    "evaluate_gaze": "nerg_mi.evaluation.held_out",
    "evaluate_radiance": "nerg_mi.evaluation.photos",
    "export_mesh": "nerg_mi.environment.conversion",
    "export_points": "nerg_mi.environment.conversion",
    "export_rays": "nerg_mi.aoi.bids",
    "export_scene": "nerg_mi.interop.scenes",
    "export_splats": "nerg_mi.environment.conversion",
    "export_torch_ngp": "nerg_mi.environment.conversion",
    "export_volume": "nerg_mi.environment.conversion",
    "filter_rays": "nerg_mi.tracking.selection",
    "find_poses": "nerg_mi.train.poses",
    "folds": "nerg_mi.evaluation.folds",
    "guess": "nerg_mi.tracking.imports",
    "import_checkpoint": "nerg_mi.environment.conversion",
    "import_rays": "nerg_mi.tracking.imports",
    "make_scene": "nerg_mi.environment.scene",
    "measure_events": "nerg_mi.tracking.measurement",
    "next_look": "nerg_mi.evaluation.next_look_scores",
    "observe": "nerg_mi.environment.queries",
    "plot_rays": "nerg_mi.figures.floor_plans",
    "refine_field": "nerg_mi.train.compile",
    "register_quadrature": "nerg_mi.transport.quadrature",
    "register_reader": "nerg_mi.tracking.readers.registry",
    "register_recipe": "nerg_mi.train.gaze_recipes",
    "render": "nerg_mi.figures.pictures",
    "render_film": "nerg_mi.figures.films",
    "render_tensor": "nerg_mi.environment.tensors",
    "report": "nerg_mi.reports.report",
    "robustness": "nerg_mi.aoi.robustness",
    "split_rays": "nerg_mi.tracking.splits",
    "statistics": "nerg_mi.aoi.statistics",
    "study": "nerg_mi.evaluation.study_run",
    "trace": "nerg_mi.environment.queries",
    "train_gaze": "nerg_mi.train.gaze",
    "train_prior": "nerg_mi.train.prior",
    "train_radiance": "nerg_mi.train.radiance",
    "view": "nerg_mi.viewer.serve",
    "write_scene": "nerg_mi.environment.scene_file",
}
"""The public names, and the module that defines each."""

__all__ = [
    "Alignment",
    "Areas",
    "Camera",
    "DensityGrid",
    "Environment",
    "GazeField",
    "NergError",
    "Photos",
    "RadianceField",
    "Rays",
    "Scene",
    "align",
    "attention",
    "bake",
    "check_rays",
    "compile_field",
    "draw_area",
    "draw_difference",
    "draw_floor",
    "draw_scanpath",
    "draw_sheet",
    "draw_sphere",
    "draw_surface",
    "draw_triptych",
    "evaluate_gaze",
    "evaluate_radiance",
    "export_mesh",
    "export_points",
    "export_rays",
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
    "make_scene",
    "measure_events",
    "next_look",
    "observe",
    "plot_rays",
    "refine_field",
    "register_quadrature",
    "register_reader",
    "register_recipe",
    "render",
    "render_film",
    "render_tensor",
    "report",
    "robustness",
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
