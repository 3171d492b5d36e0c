"""The commands: which function each one calls, and which of its parameters are arguments.

A command has one option for each keyword of its function and for each field of its settings, with the same name; help
texts are those of the docstring, and ranges those of the annotations (`.signatures`). A new command is one more row.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Row:
    """A command: words after ``nerg``, "MODULE:FUNCTION" that it calls, and its line in lists of commands.

    ``arguments`` are the parameters without a flag, in order. ``output`` is the help of ``--output``, to which the
    result is saved, and ``suffixes`` are those of this file; a function that writes during its work has a parameter
    ``output``, which the command requires if it has this help. ``more_outputs`` are optional files that the method
    ``save`` takes as well, by keyword: their help, and their spellings if they differ from the keyword. A parameter of
    the function with the same name tells it whether the file is written. Only one of the outputs is needed if any of
    them ``suffices``. ``alternatives`` are options for files of different kinds, with their help, of which at most one
    is given, by the parameter that takes them. A command that ``computes`` has ``--mode``. ``spellings`` are those of
    options that have more than their name.
    """

    name: str
    function: str
    line: str
    arguments: tuple[str, ...] = ()
    output: str = ""
    suffixes: tuple[str, ...] = ()
    more_outputs: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    suffices: bool = False
    computes: bool = True
    alternatives: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    spellings: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


TABLE = (
    Row(
        "train prior",
        "nerg_mi.api.training:train_prior",
        "Fit an elevation prior on recordings in other scenes, for a scene without tracking.",
        ("rays",),
        "Gaze field to write (.safetensors).",
        (".safetensors",),
        spellings={"seed": ("-s", "--seed")},
    ),
    Row(
        "export mesh",
        "nerg_mi.environment.conversion:export_mesh",
        "Extract a mesh with vertex colours by marching cubes (.ply, .glb).",
        ("field",),
        "Mesh to write (.ply or .glb).",
        (".ply", ".glb"),
    ),
    Row(
        "export points",
        "nerg_mi.environment.conversion:export_points",
        "Sample surface points with normals and colours (.ply, .glb).",
        ("field",),
        "Point cloud to write (.ply or .glb).",
        (".ply", ".glb"),
    ),
    Row(
        "export splats",
        "nerg_mi.environment.conversion:export_splats",
        'Place Gaussian splats on the surface (.ply), for splat viewers and the volume "splats".',
        ("field",),
        "Gaussian splats to write (.ply).",
        (".ply",),
    ),
    Row(
        "export volume",
        "nerg_mi.environment.conversion:export_volume",
        "Sample density and colour on a grid, as Mitsuba grid volumes (.vol).",
        ("field",),
        "Grid volume of the density to write (.vol).",
        (".vol",),
        {"color": ("Second file (.vol), for the colour. Default: not written.",)},
    ),
    Row(
        "export torch-ngp",
        "nerg_mi.environment.conversion:export_torch_ngp",
        "Write a torch-ngp checkpoint (.pth), for fields whose grid and networks fit its layout.",
        ("field",),
        "Checkpoint to write (.pth).",
        (".pth",),
    ),
    Row(
        "align",
        "nerg_mi.alignment.align:align",
        "Register tracking with a scene: estimate, check and write the alignment.",
        ("rays",),
        "Alignment to write (.json), for --align of other commands; a plot is written next to it.",
        alternatives={
            "environment": {
                "field": "Radiance field (.safetensors) or Gaussian splats of the scene.",
                "scene": "Mitsuba scene (.xml) or mesh, in place of --field.",
            }
        },
    ),
    Row(
        "poses",
        "nerg_mi.train.poses:find_poses",
        "Estimate the camera poses of photos or video frames.",
        ("pictures",),
        computes=False,
    ),
    Row(
        "import",
        "nerg_mi.environment.conversion:import_checkpoint",
        "Convert checkpoints of torch-ngp and of the NeRG paper's authors.",
        ("file",),
        "Radiance field to write (.safetensors).",
        (".safetensors",),
        {"gaze": ("Gaze field to write (.safetensors).", "-g", "--gaze")},
        suffices=True,
    ),
    Row(
        "refine",
        "nerg_mi.train.refine:refine_field",
        "Compute a finer occupancy grid of a radiance field, so that it renders faster.",
        ("field",),
        "Radiance field to write (.safetensors).",
        (".safetensors",),
    ),
    Row(
        "compile",
        "nerg_mi.train.compile:compile_field",
        "Evaluate the density of a radiance field on voxels once, so that it renders faster.",
        ("field",),
        "Compiled radiance field to write (.safetensors).",
        (".safetensors",),
    ),
)
ROWS = {row.name: row for row in TABLE}
