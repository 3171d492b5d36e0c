"""The commands: which function each one calls, and which of its parameters are arguments.

A command has one option for each keyword of its function and for each field of its settings, with the same name; help
texts are those of the docstring, and ranges those of the annotations (`.signatures`). A new command is one more row.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from nerg_mi.options import ANALYSIS, INPUT, MAIN, MODEL, OUTPUT, PERFORMANCE, TEST, TRAINING, VIEW


@dataclass(frozen=True)
class Row:
    """A command: words after ``nerg``, "MODULE:FUNCTION" that it calls, and its line in lists of commands.

    ``arguments`` are the parameters without a flag, in order. ``output`` is the help of ``--output``, to which the
    result is saved, and ``suffixes`` are those of this file; a function that writes during its work has a parameter
    ``output``, which the command requires if it has this help. ``more_outputs`` are optional files that the method
    ``save`` takes as well, by keyword: their help, and their spellings if they differ from the keyword. The output of a
    row with ``folder`` is a folder, and one with ``several`` writes a list of files. A parameter of the function with
    the same name tells it whether the file is written. Only one of the outputs is needed if any of them ``suffices``.
    If ``--output`` is not given, files are written next to the first argument, with ``default_suffix``. A command that
    ``computes`` has ``--mode``, by default LLVM, or the ``fastest`` variant that works, and one with ``threads`` has
    ``--threads``. ``spellings`` are those of options that have more than their name. ``groups`` are the headings of
    help under which keywords are listed, and ``rest`` is that of the others. A command is ``without`` the options
    of these parameters and fields, which only developers and experts set, in Python. A command that
    ``prints`` its result, a list of reports (their method ``to_text``), needs no output. A command with ``presets`` has
    the options of all readers of tracking files (`.presets`). The result of a command that ``waits`` serves until
    Ctrl-C (its method ``wait``). The exit code is 1 if an attribute of the result, ``fails_unless``, is false.
    """

    name: str
    function: str
    line: str
    arguments: tuple[str, ...] = ()
    output: str = ""
    suffixes: tuple[str, ...] = ()
    more_outputs: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    suffices: bool = False
    folder: bool = False
    several: bool = False
    computes: bool = True
    fastest: bool = False
    threads: bool = False
    spellings: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    rest: str = MAIN
    without: tuple[str, ...] = ()
    default_suffix: str = ""
    prints: bool = False
    presets: bool = False
    waits: bool = False
    fails_unless: str = ""


_RAYS_OUTPUT = "Rays file (.npz or .parquet) or dataset (.rays) to write."

_FIGURE = "Figure to write (.png, .svg or .pdf)."
_OF_SCENES = {"defaults": ("-D", "--define"), "sensor": ("-s", "--sensor"), "persons": ("--person",)}

_OF_TRAINING = {
    MAIN: ("environment",),
    INPUT: ("align",),
    MODEL: ("recipe", "variant", "ensemble", "reaimed_hits"),
    TEST: ("folds", "splits", "test_zones", "test_positions", "test_participants"),
}

TABLE = (
    Row(
        "scene",
        "nerg_mi.environment.scene_file:write_scene",
        "Write a Mitsuba scene file for a field, a mesh, a gaze field or rays, with a camera and an observer.",
        ("inputs",),
        "Scene file to write (.xml).",
        fastest=True,
        spellings={"environment": ("-e", "--environment")},
        groups={
            INPUT: ("environment", "align", "up"),
            VIEW: ("observer", "person", "time", "time_range", "fps", "camera", "target", "first_person", "photos")
            + ("photo",),
        },
        without=("allow_outside", "width", "fov", "mode"),
    ),
    Row(
        "rays import",
        "nerg_mi.tracking.imports:import_rays",
        "Convert tracking files to rays: right-handed, z up, metres, seconds.",
        ("files",),
        _RAYS_OUTPUT,
        computes=False,
        without=("reader", "settings", "workers", "day"),
        presets=True,
    ),
    Row(
        "rays guess",
        "nerg_mi.tracking.imports:guess",
        "Propose the preset or the column map for unknown tracking files.",
        ("files",),
        computes=False,
    ),
    Row(
        "rays show",
        "nerg_mi.tracking.quality:check_environments",
        "Print a data-quality report: rays, participants, duration, rate, dropped rows, extent, eye height.",
        ("rays",),
        computes=False,
        prints=True,
    ),
    Row(
        "rays filter",
        "nerg_mi.tracking.selection:filter_rays",
        "Select rays by conditions, detect fixations, and thin out stationary periods.",
        ("rays",),
        _RAYS_OUTPUT,
        computes=False,
        spellings={"persons": ("--person",), "without_persons": ("--without-person",), "cohorts": ("--cohort",)},
        without=("thin_distance", "with_hit", "seed", "head_velocity", "pursuit_velocity", "pursuit_angle", "merge_gap")
        + ("max_blink", "eye_velocity"),
    ),
    Row(
        "rays split",
        "nerg_mi.tracking.splits:split_rays",
        "Split rays into disjoint training and test sets by position, participant or time.",
        ("rays",),
        "Rays file (.npz or .parquet); -train and -test are inserted before its suffix.",
        (".npz", ".parquet"),
        computes=False,
        spellings={"persons": ("--person",)},
        without=("zone_radius", "radius", "test_positions", "min_rays", "gap"),
    ),
    Row(
        "rays events",
        "nerg_mi.tracking.measurement:measure_events",
        "Detect fixations, saccades, pursuits and pauses, and measure data quality, per recording.",
        ("rays",),
        "CSV file to write: one event per row.",
        (".csv",),
        {"quality": ("CSV file to write: data quality of each recording. Default: not written.",)},
        computes=False,
        without=("head_velocity", "pursuit_velocity", "pursuit_angle", "merge_gap", "max_blink", "eye_velocity"),
    ),
    Row(
        "rays export",
        "nerg_mi.aoi.bids:export_rays",
        "Write rays in a format of other programs: a BIDS dataset with gaze, events and visits.",
        ("rays",),
        computes=False,
        without=("title", "events", "rules"),
    ),
    Row(
        "rays plot",
        "nerg_mi.figures.floor_plans:plot_rays",
        "Plot a floor plan of recorded positions, as densities or as the layout of a split.",
        ("rays",),
        "Image to write (.png or .svg).",
        computes=False,
        without=("axes", "cell_size"),
    ),
    Row(
        "draw sphere",
        "nerg_mi.figures.occlusion:draw_sphere",
        "Draw the gaze of an observer over all directions.",
        ("scene",),
        _FIGURE,
        fastest=True,
        spellings=_OF_SCENES,
        without=("seed", "log_decades", "hatching", "spp", "mode", "sensor"),
    ),
    Row(
        "draw triptych",
        "nerg_mi.figures.occlusion:draw_triptych",
        "Draw three views of a gaze that show its occlusion.",
        ("scene",),
        _FIGURE,
        fastest=True,
        spellings=_OF_SCENES,
        without=("seed", "log_decades", "hatching", "spp", "mode", "smoothing"),
    ),
    Row(
        "draw scanpath",
        "nerg_mi.figures.scanpath:draw_scanpath",
        "Draw numbered fixations over a view of the scene.",
        ("rays", "scene"),
        _FIGURE,
        fastest=True,
        spellings=_OF_SCENES,
        without=("seed", "dispersion_threshold", "rules", "max_fixations", "spp", "mode"),
    ),
    Row(
        "draw floor",
        "nerg_mi.figures.floor_plans:draw_floor",
        "Draw the floor plan of rays in their scene.",
        ("rays",),
        _FIGURE,
        fastest=True,
        spellings={**_OF_SCENES, "paths": ("--paths/--no-paths",)},
        without=("fov", "cut_height", "mode"),
    ),
    Row(
        "draw area",
        "nerg_mi.aoi.flat:draw_area",
        "Draw the gaze on a flat area from its front, with a table.",
        ("inputs",),
        _FIGURE,
        (".png", ".svg", ".pdf", ".csv"),
        {
            "samples": ("CSV file to write: coordinates of each sample on the area. Default: not written.",),
            "image": ("Picture of the area without gaze to write (.png). Default: not written.",),
        },
        suffices=True,
        fastest=True,
        spellings={"corners": ("--corner",)},
        groups={INPUT: ("aois", "area", "corners", "align", "objects")},
        without=("hatching", "log_decades", "mode"),
    ),
    Row(
        "draw sheet",
        "nerg_mi.figures.image_files:draw_sheet",
        "Draw several images on one page, with a common colour scale.",
        ("images",),
        _FIGURE,
        computes=False,
        without=("log_decades", "hatching", "columns"),
    ),
    Row(
        "draw difference",
        "nerg_mi.figures.image_files:draw_difference",
        "Draw the difference of a channel between two images.",
        ("first", "second"),
        _FIGURE,
        computes=False,
    ),
    Row(
        "draw surface",
        "nerg_mi.surfaces.baked:draw_surface",
        "Draw gaze on a mesh, with its colour scale.",
        ("surface",),
        _FIGURE,
        fastest=True,
        without=("hatching", "log_decades", "fov", "up", "mode"),
    ),
    Row(
        "train gaze",
        "nerg_mi.train.gaze:train_gaze",
        "Train a gaze field on gaze rays and score it at held-out positions.",
        ("rays",),
        "Gaze field to write (.safetensors).",
        spellings={"environment": ("-e", "--environment")},
        groups={**_OF_TRAINING, INPUT: ("align", "force", "views", "salience", "align_views")},
        rest=TRAINING,
        without=(
            "probes",
            "directions",
            "salience_unit",
            "allow_outside",
            "voxel_size",
            "max_samples",
            "prior_folds",
            "validation_zones",
            "save_every",
            "half",
        ),
        threads=True,
    ),
    Row(
        "train radiance",
        "nerg_mi.train.radiance:train_radiance",
        "Train a radiance field on posed photos and report the error on held-out views.",
        ("photos",),
        "Radiance field to write (.safetensors).",
        groups={
            INPUT: ("width", "scale", "coordinates", "depth", "allow_outside"),
            MODEL: ("size", "deferred", "aabb", "unbounded"),
            TRAINING: ("minutes", "steps", "seed", "resume"),
            TEST: ("holdout",),
            OUTPUT: ("view",),
        },
        spellings={"unbounded": ("--unbounded/--bounded",)},
        without=("settings", "photo_colors", "save_every", "port", "half"),
        threads=True,
    ),
    Row(
        "eval radiance",
        "nerg_mi.evaluation.photos:evaluate_radiance",
        "Score a radiance field on held-out views: PSNR, SSIM and, where it is known, depth error.",
        ("field", "photos"),
        "Folder for the rendered images, each next to its photo.  [default: FIELD.eval]",
        groups={
            INPUT: ("width", "scale", "coordinates", "depth", "allow_outside"),
            TEST: ("train", "views", "holdout"),
            OUTPUT: ("json",),
        },
        default_suffix=".eval",
        without=("spp",),
    ),
    Row(
        "eval gaze",
        "nerg_mi.evaluation.held_out:evaluate_gaze",
        "Score a gaze field on held-out data and compare it with baselines.",
        ("gaze", "rays"),
        "Folder for tables and figures.  [default: GAZE.eval]",
        spellings={"environment": ("-e", "--environment")},
        default_suffix=".eval",
        without=("prior_kappa", "directions", "pictures", "kappa"),
        threads=True,
    ),
    Row(
        "eval folds",
        "nerg_mi.evaluation.folds:folds",
        "Cross-validate a gaze field: train and score it several times on different splits.",
        ("rays",),
        "Folder for the tables.",
        spellings={"environment": ("-e", "--environment")},
        groups=_OF_TRAINING,
        rest=TRAINING,
        without=(
            "probes",
            "directions",
            "max_samples",
            "variant",
            "prior_folds",
            "reaimed_hits",
            "test_positions",
            "kappa",
        ),
    ),
    Row(
        "eval next",
        "nerg_mi.evaluation.next_look_scores:next_look",
        "Predict the next look from the last looks and a gaze field; score it on held-out participants.",
        ("gaze", "rays"),
        "Folder for tables and weights.  [default: GAZE.next]",
        spellings={"environment": ("-e", "--environment")},
        default_suffix=".next",
        without=("earlier", "max_looks", "seed"),
    ),
    Row(
        "train prior",
        "nerg_mi.train.prior:train_prior",
        "Fit an elevation prior on recordings in other scenes, for a scene without tracking.",
        ("rays",),
        "Gaze field to write (.safetensors).",
        (".safetensors",),
        spellings={"seed": ("-s", "--seed")},
        without=("max_samples", "seed", "mode"),
    ),
    Row(
        "export mesh",
        "nerg_mi.environment.conversion:export_mesh",
        "Extract a mesh with vertex colours by marching cubes (.ply, .glb).",
        ("field",),
        "Mesh to write (.ply or .glb).",
        (".ply", ".glb"),
        without=("keep_unseen",),
    ),
    Row(
        "export points",
        "nerg_mi.environment.conversion:export_points",
        "Sample surface points with normals and colours (.ply, .glb).",
        ("field",),
        "Point cloud to write (.ply or .glb).",
        (".ply", ".glb"),
        without=("density_threshold", "max_points"),
    ),
    Row(
        "export splats",
        "nerg_mi.environment.conversion:export_splats",
        'Place Gaussian splats on the surface (.ply), for splat viewers and the volume "splats".',
        ("field",),
        "Gaussian splats to write (.ply).",
        (".ply",),
        without=("density_threshold",),
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
        without=("mode",),
    ),
    Row(
        "export scene",
        "nerg_mi.interop.scenes:export_scene",
        "Write a scene with its gaze for Rerun (.rrd) or OpenUSD (.usdc, .usda).",
        ("inputs",),
        "File to write (.rrd, .usdc, .usda or .usd).",
        spellings={"defaults": ("-D", "--define")},
        groups={INPUT: ("up", "meters_per_unit", "defaults")},
        without=("spp", "width", "max_rays", "max_points", "rules", "vmax"),
    ),
    Row(
        "align",
        "nerg_mi.alignment.align:align",
        "Register tracking with a scene: estimate, check and write the alignment.",
        ("rays",),
        "Alignment to write (.json), for --align of other commands; a plot is written next to it.",
        spellings={"environment": ("-e", "--environment")},
        without=("seed", "max_residual", "mode", "scene_floor_height"),
    ),
    Row(
        "poses",
        "nerg_mi.train.poses:find_poses",
        "Estimate the camera poses of photos or video frames.",
        ("pictures",),
        computes=False,
        without=("single_camera", "allow_outside", "seed", "matching"),
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
        without=("ema", "half", "mode"),
    ),
    Row(
        "refine",
        "nerg_mi.train.compile:refine_field",
        "Compute a finer occupancy grid of a radiance field, so that it renders faster.",
        ("field",),
        "Radiance field to write (.safetensors).",
        (".safetensors",),
    ),
    Row(
        "compile",
        "nerg_mi.train.compile:compile_field",
        "Evaluate the density, and the colour, of a radiance field on voxels once, so that it renders faster.",
        ("field",),
        "Compiled radiance field to write (.safetensors).",
        (".safetensors",),
        without=("max_depth_error",),
    ),
    Row(
        "bake",
        "nerg_mi.surfaces.bake:bake",
        "Compute the gaze per unit area of surfaces, as colours and tables.",
        ("surface",),
        "File to write, repeatable: .ply, .glb (with colours), .csv (table of faces), .json (summary); for Gaussian "
        "splats .ply and .json.",
        (".ply", ".glb", ".csv", ".json"),
        several=True,
        fastest=True,
        spellings={"shapes": ("--shape",)},
        without=("max_samples", "num_observers", "resolution", "log_decades", "seed"),
    ),
    Row(
        "stats",
        "nerg_mi.aoi.statistics:statistics",
        "Compute attention statistics of areas of interest, measured and predicted, with confidence intervals.",
        ("inputs",),
        "Folder for tables and figures.",
        folder=True,
        fastest=True,
        spellings={"windows": ("--window",), "observers": ("--observer",)},
        groups={
            INPUT: ("aois", "align", "cohorts", "validation", "windows", "zones", "objects", "pose_gap", "clock_offset")
            + ("what_if", "observers"),
            ANALYSIS: ("viewpoints", "aoi_visibility", "resamples", "power", "seed"),
            OUTPUT: ("min_participants", "show_names", "salt"),
        },
        without=("fov", "eye_height", "floor_height", "grid_step"),
    ),
    Row(
        "robustness",
        "nerg_mi.aoi.robustness:robustness",
        "Test whether conclusions of attention statistics survive other choices of filters, areas and alignment.",
        ("inputs",),
        "Folder for tables and a figure.",
        folder=True,
        fastest=True,
        spellings={"windows": ("--window",)},
        groups={INPUT: ("aois", "align", "cohorts", "validation", "windows", "zones"), ANALYSIS: ("analyses", "seed")},
        without=("choices", "viewpoints", "resamples", "min_visit", "tolerance"),
    ),
    Row(
        "report",
        "nerg_mi.reports.report:report",
        "Write an HTML report on a gaze field: verdict, figures, scores and a 3D view in one file.",
        ("inputs",),
        "File to write (.html).",
        (".html", ".htm"),
        fastest=True,
        without=("seed", "fov", "viewpoints", "max_points", "spp", "rendered"),
    ),
    Row(
        "study",
        "nerg_mi.evaluation.study_run:study",
        "Measure rendering error against run time over many settings of the integrator.",
        ("scene",),
        "Folder to write to; it is created.",
        folder=True,
        fastest=True,
        spellings={"defaults": ("-D", "--define")},
    ),
    Row(
        "demo",
        "nerg_mi.cli.demo:make_demo",
        "Render the demo store: images, figures and a report of a gaze field.",
        fastest=True,
        without=("scene", "spp", "seed", "defaults"),
    ),
    Row(
        "render",
        "nerg_mi.figures.films:render_film",
        "Render a scene file to an image or a video.",
        ("scene",),
        "Image (.exr with all channels, .png; .svg needs --overlay) or video (.mp4, needs --frames) to write.",
        fastest=True,
        spellings={"defaults": ("-D", "--define"), "sensor": ("-s", "--sensor")},
        groups={
            INPUT: ("frames", "defaults", "objects", "time", "person", "align"),
            VIEW: ("sensor", "overlay", "vmax", "smoothing"),
            OUTPUT: ("fps",),
            PERFORMANCE: ("spp", "memory"),
        },
        without=("hatching", "seed"),
    ),
    Row(
        "view",
        "nerg_mi.viewer.serve:view",
        "Show a scene with its gaze in the browser, with a movable observer.",
        ("inputs",),
        fastest=True,
        spellings={"areas": ("--aois",)},
        groups={INPUT: ("up", "areas", "align"), OUTPUT: ("host", "port"), PERFORMANCE: ("compile",)},
        waits=True,
        without=("spp", "width", "hostnames", "observer"),
    ),
    Row(
        "doctor",
        "nerg_mi.diagnosis:run_diagnosis",
        "Check the installation and suggest fixes.",
        computes=False,
        prints=True,
        fails_unless="is_usable",
    ),
    Row(
        "jobs",
        "nerg_mi.tasks.jobs:report_jobs",
        "Show the progress of jobs that run in parts, and what in their store is stale.",
        ("folder",),
        computes=False,
    ),
    Row(
        "worker",
        "nerg_mi.tasks.cluster:run_worker",
        "Run parts of jobs for a dask cluster.",
        ("address",),
        computes=False,
        spellings={"threads": ("-t", "--threads")},
        without=("wait",),
    ),
)
ROWS = {row.name: row for row in TABLE}
