"""Tests of `nerg_mi.workflows.train_gaze`."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.cli import main
from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_log_density import LogGazeConfig
from nerg_mi.files.atomic import reserve_output
from nerg_mi.formats.fields import load_gaze
from nerg_mi.interruption import TrainingInterrupted
from nerg_mi.maths.geometry import Similarity
from nerg_mi.train import gaze_recipes
from nerg_mi.train.gaze_data import compute_surface_distances
from nerg_mi.train.gaze_log_density import LikelihoodTrainer, get_geometry_options
from nerg_mi.train.gaze_recipes import Recipe, register_recipe
from nerg_mi.train.gaze_settings import ProbeSettings
from nerg_mi.workflows import train_gaze as module
from nerg_mi.workflows.gaze_commands import GazeOptions
from nerg_mi.workflows.train_gaze import check_plan, plan_gaze, train_gaze
from nerg_mi.workflows.train_radiance import train_radiance
from tests.evaluation.test_gaze import crowd
from tests.train.gaze.looks import BOX, RAYS, looking_at
from tests.workflows.recorder import Recorder

# ---- The training of a gaze field, also by its command: geometries, recipes, hold-out, resuming, messages ----


QUICK = GazeOptions(geometry="none", radius=0.5, probes=6, min_rays=8, steps=3, directions=64, validation_zones=0)
WALL = """<scene version="3.0.0"><shape type="rectangle"><transform name="to_world">
    <scale value="2"/><lookat origin="1.5, 0, 1.5" target="0, 0, 1.5" up="0, 0, 1"/></transform></shape></scene>"""


class Listener:
    """A reporter that records its messages and stops a training at a fraction of its progress."""

    def __init__(self, ends_at: float = 2.0):
        self.messages, self.shares, self.texts, self.ends_at = [], [], [], ends_at

    def message(self, text):
        self.messages.append(text)

    warn = message

    def progress(self, share, text=""):
        self.shares.append(share)
        self.texts.append(text)
        if share >= self.ends_at:
            self.ends_at = 2.0
            raise KeyboardInterrupt


@pytest.fixture
def rays():
    return looking_at((1.5, 0.4, 1.2))


def nerg(capsys, *arguments):
    """Exit code of a command, and its standard output and standard error."""
    with pytest.raises(SystemExit) as end:
        main(["train", "gaze", *map(str, arguments)])
    said = capsys.readouterr()
    return end.value.code or 0, said.out, " ".join(said.err.split())


def arrays(field):
    return {name: np.array(value) for name, value in field.parameters().items()}


def test_a_training_returns_the_field_and_reports_progress(rays):
    """The rays are in memory; no file is read or written."""
    heard = Listener()
    result = train_gaze(rays.with_tracking("head"), options=replace(QUICK, variant="capture"), reporter=heard)
    assert result.output is None and not result.interrupted and result.field.config.geometry == "none"
    provenance = result.provenance
    assert provenance["recipe"] == "default" and provenance["steps"] == 3 and provenance["geometry"] == "none"
    assert "rays_file" not in provenance and provenance["rays"] == len(rays)
    assert provenance["tracking"] == result.field.basis.tracking == "head"
    assert heard.shares == sorted(heard.shares) and heard.shares[-1] == pytest.approx(1)
    # One fit, and folds that take as many steps each
    last_fit = max(share for share, text in zip(heard.shares, heard.texts) if text.startswith("fit"))
    assert last_fit == pytest.approx(1 / (1 + provenance["settings"]["prior_folds"]))
    assert heard.texts[0].startswith("placing probes") and "fit: step 3" in heard.texts
    assert heard.texts[-1].startswith("folds: step") and provenance["mix"]["folds"] == 1
    summaries = [m.split(";")[0].split(":")[0] for m in heard.messages]
    assert summaries[:3] == [f"{provenance['probes_made']} probes", "3 steps", "cross-validation (1 fold)"]
    assert (
        summaries[3]
        == f"regions with {100 * provenance['mix']['regions']['80%']:.0f} % of the field's gaze contain 80 % "
        "of the held-out gaze"
    )


def test_without_geometry_folds_select_the_variant(rays):
    """Folds run before the fit; their choice is reported and trained."""
    heard = Listener()
    result = train_gaze(rays, options=QUICK, reporter=heard)
    assert heard.shares == sorted(heard.shares) and heard.shares[-1] == pytest.approx(1)
    mix = result.provenance["mix"]
    assert set(mix["variants"]) == {"capture", "emit_capture"} and mix["variant"] == result.field.config.variant
    assert mix["mix"] == pytest.approx((1 - mix["hits_weight"]) * result.field.config.mix)
    assert (mix["hits_weight"] > 0) == (result.field.hits is not None)
    order = [text.split(":")[0] for text in heard.texts if "fold" in text or "fit" in text]
    assert list(dict.fromkeys(order))[-1] == "fit" and order[0].startswith("fold 1 of capture")
    assert heard.messages[0].startswith("there is no geometry: cross-validation chooses")
    assert any(m.endswith(f"the variant {mix['variant']} is trained") for m in heard.messages)
    # Without folds the variant is not selected.
    heard = Listener()
    result = train_gaze(rays, options=replace(QUICK, prior_folds=0), reporter=heard)
    assert result.field.config.variant == "capture" and "mix" not in result.provenance
    assert heard.messages[0] == "there is no geometry: capture alone is trained"


def test_function_and_command_write_equal_files(rays, tmp_path, capsys):
    rays.save(tmp_path / "rays.npz")
    options = replace(QUICK, geometry="hits", voxel_size=0.2, half=True, threads=1)
    train_gaze(tmp_path / "rays.npz", tmp_path / "job" / "gaze.safetensors", options)
    line = "--geometry hits --voxel-size 0.2 --radius 0.5 --probes 6 --min-rays 8 --steps 3 --directions 64"
    line += " --validation-zones 0 --half"
    code, said, _ = nerg(
        capsys, tmp_path / "rays.npz", "-o", tmp_path / "command" / "gaze.safetensors", *line.split(), "--threads", 1
    )
    assert code == 0 and "hit no surface" in said and "gaze.vol: " in said and "MB)" in said
    fields, provenance = [], []
    for name in ("job", "command"):
        assert {p.name for p in (tmp_path / name).iterdir()} == {"gaze.safetensors", "gaze.vol"}
        field, meta = load_gaze(tmp_path / name / "gaze.safetensors", ns)
        fields.append(arrays(field))
        provenance.append(meta["provenance"])
    for name, value in fields[0].items():
        np.testing.assert_array_equal(value, fields[1][name], err_msg=name)
    for entry in provenance:
        assert entry["steps"] == 3 and len(entry["rays_file"]["sha256"]) == len(entry["geometry_file"]["sha256"]) == 64
        for name in ("made", "seconds", "seconds_preparing"):
            entry.pop(name)
    assert provenance[0] == provenance[1]


@pytest.mark.parametrize("recipe", ["default", "small", "paper"])
def test_recipes_in_a_scene_of_shapes(rays, tmp_path, recipe):
    """The wall as a shape: its distance is exact, and rays that miss it escape."""
    (tmp_path / "scene.xml").write_text(WALL)
    size = "small" if recipe == "paper" else None
    options = replace(QUICK, geometry=None, scene=tmp_path / "scene.xml", recipe=recipe, size=size, steps=2)
    result = train_gaze(rays, tmp_path / "gaze.safetensors", options)
    field, meta = load_gaze(tmp_path / "gaze.safetensors", ns)
    assert meta["provenance"] == result.provenance and 0.3 < result.provenance["escaped_directions"] < 0.9
    assert meta["output"] == {
        "activation": {"default": "log", "small": "softplus", "paper": "linear"}[recipe],
        "normalized": recipe == "default",
    }
    place = Environment.open(tmp_path / "scene.xml")
    o, d = np.array([[-0.5, 0.2, 1.6]]), np.array([[[1.0, 0, 0], [0.8, 0.6, 0], [-1.0, 0, 0]]])
    distance, escaped = compute_surface_distances(place, o, d)
    np.testing.assert_allclose(distance[0, :2], [2.0, 2.5], rtol=1e-5)
    assert escaped.tolist() == [[False, False, True]]


def test_a_registered_recipe_trains_from_function_and_command(rays, tmp_path, monkeypatch, capsys):
    """A second log density in the registry: hold-out and ensembles find it by its entry."""
    monkeypatch.setattr(gaze_recipes, "RECIPES", dict(gaze_recipes.RECIPES))
    grid = HashGridConfig(levels=2, log2_rows=8, base=2, finest=4)
    register_recipe(
        Recipe(
            name="coarse",
            summary="a log density on two levels",
            make_config=lambda c: LogGazeConfig(grid, c.variant, width=8, **get_geometry_options(c.geometry_kind)),
            trainer=LikelihoodTrainer,
            losses=("likelihood",),
            settings={
                "steps": 3,
                "validation_zones": 0,
                "loss": "likelihood",
                "integral_weight": 0.0,
                "probes": 4,
                "directions": 32,
            },
            probes={"radius": 0.5, "probes": 6, "min_rays": 8, "directions": 64},
        )
    )
    result = train_gaze(rays, options=GazeOptions(geometry="none", recipe="coarse", variant="emit", threads=1))
    assert result.field.config.grid == grid and result.field.config.geometry == "none"
    assert result.provenance["recipe"] == "coarse" and result.provenance["steps"] == 3
    RAYS.save(tmp_path / "rays.npz")
    out = tmp_path / "gaze.safetensors"
    line = "--geometry hits --voxel-size 0.3 --recipe coarse --test-zones 1 --test-positions 4 --min-rays 8"
    code, _, said = nerg(capsys, tmp_path / "rays.npz", "-o", out, *line.split())
    assert code == 0, said
    field, meta = load_gaze(out, ns)
    assert field.config.escaped == "nearest" and len(meta["provenance"]["test"]["centres"]) == 4
    with pytest.raises(NergError, match="the recipe coarse does not support loss; add"):
        check_plan(GazeOptions(geometry="none", recipe="coarse", loss="paper"))


def test_held_out_positions_and_participants_are_reported(tmp_path):
    heard = Listener()
    options = replace(QUICK, test_zones=2, test_positions=6, test_participants=0.5)
    result = train_gaze(RAYS, options=replace(options, min_rays=8), reporter=heard)
    test = result.provenance["test"]
    assert result.provenance["rays"] == test["rays_to_train"] < test["rays"] == len(RAYS) and len(test["people"]) == 1
    assert (
        heard.messages[0]
        == f"6 test positions held out, {test['rays_to_train']:,} of {test['rays']:,} rays remain for training"
    )


def test_an_interrupted_training_stops_the_script_and_reports_how_to_resume(rays, tmp_path):
    """The exception has the field so far."""
    options = replace(QUICK, steps=8, resample_directions=True, threads=1, variant="capture", prior_folds=0)
    with pytest.raises(TrainingInterrupted, match="4 steps") as end:
        train_gaze(rays, options=options, reporter=Listener(0.5))
    assert end.value.provenance["steps"] == 4 and end.value.provenance["interrupted"]
    assert arrays(end.value.field)
    out = tmp_path / "gaze.safetensors"
    with pytest.raises(KeyboardInterrupt, match="interrupted; continue with resume"):
        train_gaze(rays, out, options, Listener(0.5))
    assert {p.name for p in tmp_path.iterdir()} == {"gaze.safetensors", "gaze.run"}
    field, meta = load_gaze(out, ns)
    assert meta["provenance"]["interrupted"]
    for name, value in arrays(field).items():
        np.testing.assert_array_equal(value, arrays(end.value.field)[name], err_msg=name)
    complete = train_gaze(rays, options=options)
    resumed = train_gaze(rays, out, replace(options, resume=True))
    assert not out.with_suffix(".run").exists() and not resumed.interrupted and resumed.provenance["steps"] == 8
    for name, value in arrays(complete.field).items():
        np.testing.assert_array_equal(value, arrays(resumed.field)[name], err_msg=name)
    with pytest.raises(NergError, match="no state to resume"):
        train_gaze(rays, out, replace(options, resume=True))


def test_the_command_resumes_a_training(tmp_path, monkeypatch, capsys):
    from nerg_mi.train.gaze_trainer import GazeTrainer

    RAYS.save(tmp_path / "rays.npz")
    out = tmp_path / "gaze.safetensors"
    line = [tmp_path / "rays.npz", "-o", out, *"--geometry none --radius 0.5 --probes 6 --steps 8".split()]
    line += "--directions 64 --validation-zones 0 --variant capture".split()
    code, _, said = nerg(capsys, *line, "--resume")
    assert code == 1 and "there is no state to resume" in said
    step = GazeTrainer.step

    def interrupted(trainer):
        import signal

        step(trainer)
        if trainer.steps == 5:
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as change:
        change.setattr(GazeTrainer, "step", interrupted)
        code, _, said = nerg(capsys, *line)
    assert code == 130 and "--resume" in said and out.is_file() and out.with_suffix(".run").is_file()
    code, _, said = nerg(capsys, *line, "--resume")
    provenance = load_gaze(out, ns)[1]["provenance"]
    assert provenance["steps"] == 8 and not provenance["interrupted"]
    assert code == 0 and "go on" not in said and not out.with_suffix(".run").exists()


def test_an_ensemble_is_one_option(tmp_path):
    from tests.train.gaze.test_ensemble import crowd

    out = tmp_path / "gaze.safetensors"
    options = replace(QUICK, steps=2, validation_zones=1, ensemble=2, half=True)
    heard = Listener()
    train_gaze(crowd(), out, options, heard)
    field, meta = load_gaze(out, ns)
    ensemble = meta["provenance"]["ensemble"]
    assert len(field.members) == 2 and ensemble["members"] == 2 and len(ensemble["validation"]) == 2
    assert any(m.startswith("validation:") for m in heard.messages)
    assert field.support.cells[:, 3].sum() == 1200 and [p.name for p in tmp_path.iterdir()] == ["gaze.safetensors"]


def test_hit_point_geometry_needs_a_file(rays):
    with pytest.raises(NergError, match='resume=True and geometry="hits" need an output'):
        train_gaze(rays, options=replace(QUICK, geometry="hits"))


@pytest.mark.parametrize("train", [train_gaze, train_radiance])
def test_an_output_is_locked_during_training(tmp_path, train):
    with (
        reserve_output(tmp_path / "a.safetensors"),
        pytest.raises(NergError, match="wait until it has finished, or choose another"),
    ):
        train(tmp_path / "nothing", tmp_path / "a.safetensors")


# ---- Options of a gaze training: valid combinations, and their values in the plan ----


HITS = GazeOptions(geometry="hits")
FIELD = GazeOptions(field=Path("field.safetensors"), recipe="small")
VIEWS = GazeOptions(geometry="none", views=Path("photos"), salience="maps")
SCENE = Environment(None, BOX, "scene")


@pytest.mark.parametrize(
    "options, alone, said",
    [
        (GazeOptions(), False, "field=FILE.*scene=FILE.*geometry"),
        (replace(HITS, scene=Path("a.xml")), False, "one of field=FILE"),
        (GazeOptions(geometry="hit"), False, '"hits".*"none".*"hit"'),
        (GazeOptions(geometry="none"), True, "there is no training data: give a rays file, or"),
        (replace(VIEWS, geometry="hits"), True, 'test_zones, geometry="hits", align,'),
        (replace(VIEWS, prior_kappa=20.0), True, 'test_zones, geometry="hits", align,'),
        (replace(VIEWS, prior_folds=2), True, 'test_zones, geometry="hits", align,'),
        (replace(VIEWS, test_zones=1), True, 'test_zones, geometry="hits", align,'),
        (replace(VIEWS, salience=None), False, "saliency maps, or spectral-residual"),
        (replace(HITS, align_views=Path("a.json")), False, "saliency maps, or spectral-residual"),
        (replace(HITS, align=Path("a.json")), False, "align.*field.*scene"),
        (replace(HITS, test_participants=0.5), False, "test_participants needs test positions: add"),
        (replace(FIELD, init="nerf"), False, '"random".*"field"'),
        (replace(FIELD, freeze=True), False, "freeze"),
        (replace(HITS, recipe="small", init="field"), False, 'init="field" needs a radiance field: add field'),
        (replace(HITS, recipe="small", semantic="snapshot"), False, "semantic"),
        (replace(HITS, loss="paper"), False, 'add recipe="small"'),
        (replace(HITS, integral_weight=1.0), False, "the recipe default does not support"),
        (replace(HITS, recipe="small", prior_kappa=20.0), False, "the recipe small does not support"),
        (replace(HITS, recipe="small", prior_folds=2), False, "the recipe small does not support"),
        (replace(HITS, prior_kappa=2000.0), False, "the position-independent prior is stored in a"),
        (replace(HITS, activation="exp"), False, "the recipe default does not support"),
        (replace(FIELD, loss="likelihood"), False, '"likelihood"'),
        (replace(HITS, recipe="large"), False, "one of default, small, paper"),
        (replace(HITS, variant="both"), False, "variant.*activation"),
        (replace(FIELD, semantic="glance"), False, "of a gaze field must be one of accumulated,"),
        (GazeOptions(geometry="none", recipe="small"), False, "needs surfaces"),
    ],
)
def test_contradictory_options_are_refused(options, alone, said):
    with pytest.raises(NergError, match=said):
        check_plan(options, alone)


@pytest.mark.parametrize("options, alone", [(HITS, False), (FIELD, False), (VIEWS, True), (VIEWS, False)])
def test_compatible_options_are_accepted(options, alone):
    assert check_plan(options, alone).radius == 0.25  # noqa: RUF069 (stored)


def test_every_option_reaches_the_plan():
    settings = {"steps": 7, "seed": 3, "loss": "code", "validation_zones": 1, "refit": False, "learning_rate": 0.5}
    settings |= {"integral_weight": 2.0}
    settings |= {"weight_decay": 0.25, "radius": 0.4, "probes": 9, "placement": "grid", "max_rays": 32, "min_rays": 4}
    settings |= {"kappa_rule": "silverman", "kappa": 11.0, "ray_weights": "person", "directions": 33}
    settings |= {"resample_directions": True}
    of_field = {"variant": "emit", "activation": "exp", "size": "paper", "normalize": True}
    plan = plan_gaze(GazeOptions(scene=Path("a.xml"), recipe="small", **settings, **of_field), SCENE)
    names = {}
    for part in (plan.settings, plan.probes):
        names |= {f.name: getattr(part, f.name) for f in fields(part)}
    # The directions of a batch and of a probe are different settings.
    assert {name: names[name] for name in settings} == settings and plan.probes.directions == 33
    c = plan.config
    assert (c.variant, c.activation, c.grid.levels, c.normalized) == ("emit", "exp", 16, True)


def test_views_near_test_positions_are_left_out_in_scene_units(monkeypatch):
    options = GazeOptions(test_zones=1, test_positions=3)
    arguments = crowd(1000), options, ProbeSettings(radius=0.5, min_rays=8), Similarity(np.diag([10.0, 10, 10, 1]))
    test = module._supervision(*arguments, Recorder())[1]["test"]
    centre = 10 * np.array(test["centres"][0])
    near, far = (SimpleNamespace(camera=SimpleNamespace(center=centre + [0, 0, z])) for z in (9.0, 11.0))
    views = SimpleNamespace(views=[near, far], provenance={}, notes=(), frames_without_map=(), unmatched_files=())
    monkeypatch.setattr(module, "_open_views", lambda *args: (views, {}))
    arguments = arguments[0], replace(options, views=Path("a"), salience="b"), *arguments[2:]
    assert module._supervision(*arguments, Recorder())[0].views == (far,)


def test_views_alone_make_a_normalised_field():
    """Views have no total amount of gaze."""
    options = GazeOptions(scene=Path("a.xml"), recipe="small")
    assert plan_gaze(options, SCENE, views_alone=True).config.normalized
    assert not plan_gaze(options, SCENE).config.normalized
