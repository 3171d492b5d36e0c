"""Tests of `nerg_mi.train.gaze`."""

from __future__ import annotations

import inspect
import re
from dataclasses import fields, replace
from types import SimpleNamespace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.cli import main
from nerg_mi.environment.environment import Environment
from nerg_mi.environment.gaze import GazeField
from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_log_density import LogGazeConfig
from nerg_mi.files.atomic import reserve_output
from nerg_mi.formats.checkpoint import read_checkpoint
from nerg_mi.formats.fields import load_gaze
from nerg_mi.interruption import Interrupted, TrainingInterrupted
from nerg_mi.maths.geometry import Similarity
from nerg_mi.threads import set_thread_count
from nerg_mi.train import gaze as module
from nerg_mi.train import gaze_recipes
from nerg_mi.train.gaze import train_gaze
from nerg_mi.train.gaze_data import compute_surface_distances
from nerg_mi.train.gaze_folds import PriorSelection
from nerg_mi.train.gaze_log_density import LikelihoodTrainer, get_geometry_options
from nerg_mi.train.gaze_recipes import FieldOptions, Recipe, get_recipe, register_recipe
from nerg_mi.train.gaze_settings import GazeSettings, ProbeSettings
from nerg_mi.train.radiance import train_radiance
from tests.plugins.fields import radiance
from tests.train.gaze.looks import BOX, RAYS, looking_at
from tests.train.gaze.test_ensemble import crowd

# ---- The training of a gaze field, also by its command: geometries, recipes, hold-out, resuming, messages ----


QUICK = {"radius": 0.5, "probes": 6, "min_rays": 8, "steps": 3, "directions": 64, "validation_zones": 0}
FOLDED = {**QUICK, "prior_folds": 1}  # more folds take long
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


@pytest.fixture
def single_thread():
    """Sums of one thread have one order."""
    before = dr.thread_count()
    set_thread_count(1)
    yield
    set_thread_count(before)


def arrays(field):
    return {name: np.array(value) for name, value in field.parameters().items()}


def test_a_training_returns_the_field_and_reports_progress(rays):
    """The rays are in memory; no file is read or written."""
    heard = Listener()
    options = {**QUICK, "prior_folds": 2, "variant": "capture"}
    result = train_gaze(rays.with_tracking("head"), "none", **options, progress=heard)
    assert result.path is None and result.network.config.geometry == "none"
    provenance = result.provenance
    assert provenance["recipe"] == "default" and provenance["steps"] == 3 and provenance["geometry"] == "none"
    assert "rays_file" not in provenance and provenance["rays"] == len(rays)
    assert provenance["tracking"] == result.network.basis.tracking == "head"
    assert heard.shares == sorted(heard.shares) and heard.shares[-1] == pytest.approx(1)
    # One fit, and folds that take as many steps each
    last_fit = max(share for share, text in zip(heard.shares, heard.texts) if text.startswith("fit"))
    assert last_fit == pytest.approx(1 / (1 + provenance["settings"]["prior_folds"]))
    assert heard.texts[0].startswith("placing probes") and "fit: step 3" in heard.texts
    assert heard.texts[-1].startswith("folds: step") and provenance["mix"]["folds"] == 2
    summaries = [m.split(";")[0].split(":")[0] for m in heard.messages]
    assert summaries[:3] == [f"{provenance['probes_made']} probes", "3 steps", "cross-validation (2 folds)"]
    assert (
        summaries[3]
        == f"regions with {100 * provenance['mix']['regions']['80%']:.0f} % of the field's gaze contain 80 % "
        "of the held-out gaze"
    )


def test_without_geometry_folds_select_the_variant(rays):
    """Folds run before the fit; their choice is reported and trained."""
    heard = Listener()
    result = train_gaze(rays, "none", **{**QUICK, "prior_folds": 2}, progress=heard)
    assert heard.shares == sorted(heard.shares) and heard.shares[-1] == pytest.approx(1)
    mix = result.provenance["mix"]
    assert set(mix["variants"]) == {"capture", "emit_capture"} and mix["variant"] == result.network.config.variant
    hits_weight = sum(weight for weight, *_ in mix["hits"])
    assert mix["mix"] == pytest.approx((1 - hits_weight) * result.network.config.mix, abs=1e-6)
    assert (hits_weight > 0) == (result.network.hits is not None)
    order = [text.split(":")[0] for text in heard.texts if "fold" in text or "fit" in text]
    assert list(dict.fromkeys(order))[-1] == "fit" and order[0].startswith("fold 1 of capture")
    assert heard.messages[0].startswith("there is no geometry: cross-validation chooses")
    assert any(m.endswith(f"these samples chose the variant {mix['variant']} and the weights") for m in heard.messages)
    # Without folds the variant is not selected.
    heard = Listener()
    result = train_gaze(rays, "none", **{**QUICK, "prior_folds": 0}, progress=heard)
    assert result.network.config.variant == "capture" and "mix" not in result.provenance
    assert heard.messages[0] == "there is no geometry: the variant capture is trained"
    # Nor if the recipe has one.
    heard = Listener()
    train_gaze(rays, "none", **FOLDED, recipe=change("default", {"variant": "emit_capture"}), progress=heard)
    assert heard.messages[0] == "there is no geometry: the variant emit_capture is trained"


def test_function_and_command_write_equal_files(rays, tmp_path, capsys, single_thread):
    rays.save(tmp_path / "rays.npz")
    options = {"radius": 0.5, "min_rays": 8, "steps": 3, "output": tmp_path / "job" / "gaze.safetensors"}
    train_gaze(tmp_path / "rays.npz", "hits", **options)
    line = "--environment hits --radius 0.5 --min-rays 8 --steps 3"
    code, said, _ = nerg(
        capsys, tmp_path / "rays.npz", "-o", tmp_path / "command" / "gaze.safetensors", *line.split(), "--threads", 1
    )
    assert code == 0 and "hit no surface" in said and "gaze.vol" in said and "MB)" in said
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
    chosen = get_recipe(recipe)
    if recipe == "paper":
        chosen = replace(chosen, options=FieldOptions(size="small"))
    options = {**QUICK, "steps": 2, "output": tmp_path / "gaze.safetensors"}
    result = train_gaze(rays, tmp_path / "scene.xml", recipe=chosen, **options)
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
            settings=GazeSettings(
                steps=3, validation_zones=0, loss="likelihood", integral_weight=0.0, probes=4, directions=32
            ),
            probes=ProbeSettings(radius=0.5, probes=6, min_rays=8, directions=64),
        )
    )
    result = train_gaze(rays, "none", recipe="coarse", variant="emit")
    assert result.network.config.grid == grid and result.network.config.geometry == "none"
    assert result.provenance["recipe"] == "coarse" and result.provenance["steps"] == 3
    RAYS.save(tmp_path / "rays.npz")
    out = tmp_path / "gaze.safetensors"
    line = "--environment hits --recipe coarse --test-zones 1 --test-positions 4 --min-rays 8"
    code, _, said = nerg(capsys, tmp_path / "rays.npz", "-o", out, *line.split())
    assert code == 0, said
    field, meta = load_gaze(out, ns)
    assert field.config.escaped == "nearest" and len(meta["provenance"]["test"]["centres"]) == 4
    coarse = get_recipe("coarse")
    with pytest.raises(NergError, match="the recipe coarse does not support loss; use"):
        train_gaze(rays, "none", recipe=replace(coarse, settings=replace(coarse.settings, loss="paper")))


def test_held_out_positions_and_participants_are_reported(tmp_path):
    heard = Listener()
    result = train_gaze(RAYS, "none", **FOLDED, test_zones=2, test_positions=6, test_participants=0.5, progress=heard)
    test = result.provenance["test"]
    assert result.provenance["rays"] == test["rays_to_train"] < test["rays"] == len(RAYS) and len(test["people"]) == 1
    said = re.findall(r"[\d,]*\d", heard.messages[0])
    assert said == ["6", "1", f"{test['rays_to_train']:,}", f"{test['rays']:,}"]


def test_an_interrupted_training_stops_the_script_and_reports_how_to_resume(rays, tmp_path, single_thread):
    """The exception has the field so far."""
    usual = get_recipe("default")
    recipe = replace(usual, probes=replace(usual.probes, resample_directions=True))
    options = {**QUICK, "recipe": recipe, "steps": 8, "variant": "capture", "prior_folds": 0}
    with pytest.raises(TrainingInterrupted, match="4 steps") as end:
        train_gaze(rays, "none", **options, progress=Listener(0.5))
    assert end.value.provenance["steps"] == 4 and end.value.provenance["interrupted"]
    assert arrays(end.value.field.network)
    out = tmp_path / "gaze.safetensors"
    with pytest.raises(KeyboardInterrupt, match="interrupted; continue with resume"):
        train_gaze(rays, "none", **options, output=out, progress=Listener(0.5))
    assert {p.name for p in tmp_path.iterdir()} == {"gaze.safetensors", "gaze.run"}
    field, meta = load_gaze(out, ns)
    assert meta["provenance"]["interrupted"]
    for name, value in arrays(field).items():
        np.testing.assert_array_equal(value, arrays(end.value.field.network)[name], err_msg=name)
    complete = train_gaze(rays, "none", **options)
    resumed = train_gaze(rays, "none", **options, output=out, resume=True)
    assert (
        not out.with_suffix(".run").exists()
        and not resumed.provenance["interrupted"]
        and resumed.provenance["steps"] == 8
    )
    for name, value in arrays(complete.network).items():
        np.testing.assert_array_equal(value, arrays(resumed.network)[name], err_msg=name)
    with pytest.raises(NergError, match="no state to resume"):
        train_gaze(rays, "none", **options, output=out, resume=True)


def test_a_training_interrupted_after_its_folds_resumes_to_the_same_result(tmp_path, single_thread, monkeypatch):
    """Ctrl-C while the result is made."""
    rays, out = crowd(), tmp_path / "gaze.safetensors"
    options = {**FOLDED, "variant": "capture"}

    def interrupt(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(PriorSelection, "apply_prior", interrupt)
        with pytest.raises(Interrupted, match="resume=True"):
            train_gaze(rays, "none", **options, output=out)
    assert {p.name for p in tmp_path.iterdir()} == {"gaze.run"}
    assert read_checkpoint(tmp_path / "gaze.run", "gaze run")[1]["steps"] == options["steps"]
    resumed = train_gaze(rays, "none", **options, output=out, resume=True)
    complete = train_gaze(rays, "none", **options)
    assert [p.name for p in tmp_path.iterdir()] == ["gaze.safetensors"]
    assert resumed.provenance["mix"] == complete.provenance["mix"]
    for name, value in arrays(complete.network).items():
        np.testing.assert_array_equal(value, arrays(resumed.network)[name], err_msg=name)


@pytest.mark.parametrize("zones", [0, 1])
def test_a_training_interrupted_in_its_folds_resumes_to_the_same_result(tmp_path, single_thread, zones):
    """After the only fit, or after a refit on all rays."""

    class StopInFold(Listener):
        def progress(self, share, text=""):
            super().progress(share, text)
            if text.startswith("fold 2"):
                raise KeyboardInterrupt

    rays, out = crowd(), tmp_path / "gaze.safetensors"
    options = {**QUICK, "validation_zones": zones, "prior_folds": 2, "variant": "capture", "save_every": 0}
    with pytest.raises(TrainingInterrupted) as end:
        train_gaze(rays, "none", **options, output=out, progress=StopInFold())
    assert {p.name for p in tmp_path.iterdir()} == {"gaze.safetensors", "gaze.run"}
    steps = end.value.provenance["steps"]
    assert read_checkpoint(tmp_path / "gaze.run", "gaze run")[1]["steps"] == steps > 0
    assert "mix" not in end.value.provenance
    resumed = train_gaze(rays, "none", **options, output=out, resume=True)
    complete = train_gaze(rays, "none", **options)
    assert [p.name for p in tmp_path.iterdir()] == ["gaze.safetensors"]
    assert resumed.provenance["mix"] == complete.provenance["mix"] and complete.provenance["mix"]["folds"] == 2
    assert resumed.provenance.get("validation") == complete.provenance.get("validation")
    assert complete.provenance["refitted"] == bool(zones)
    for name, value in arrays(complete.network).items():
        np.testing.assert_array_equal(value, arrays(resumed.network)[name], err_msg=name)


def test_the_command_resumes_a_training(tmp_path, monkeypatch, capsys):
    from nerg_mi.train.gaze_trainer import GazeTrainer

    RAYS.save(tmp_path / "rays.npz")
    out = tmp_path / "gaze.safetensors"
    line = [tmp_path / "rays.npz", "-o", out, *"--environment none --radius 0.5 --steps 8 --variant capture".split()]
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
    out = tmp_path / "gaze.safetensors"
    options = {**FOLDED, "steps": 2, "validation_zones": 1, "ensemble": 2, "half": True}
    heard = Listener()
    train_gaze(crowd(), "none", **options, output=out, progress=heard)
    field, meta = load_gaze(out, ns)
    ensemble = meta["provenance"]["ensemble"]
    assert len(field.members) == 2 and ensemble["members"] == 2 and len(ensemble["validation"]) == 2
    assert any(m.startswith("validation:") for m in heard.messages)
    assert field.support.cells[:, 3].sum() == 1200 and [p.name for p in tmp_path.iterdir()] == ["gaze.safetensors"]


def test_hit_points_are_an_environment_in_memory(tmp_path):
    """The saved field has their file next to it, and the same densities."""
    gaze = train_gaze(RAYS, "hits", **FOLDED, voxel_size=0.3)
    assert gaze.environment is not None and gaze.environment.kind == "hits" and gaze.environment.path is None
    assert gaze.provenance["geometry_file"]["voxel"] == pytest.approx(0.3) and not list(tmp_path.iterdir())
    saved = GazeField.open(gaze.save(tmp_path / "gaze.safetensors"))
    assert {p.name for p in tmp_path.iterdir()} == {"gaze.safetensors", "gaze.vol"}
    at = RAYS.origin[:5], RAYS.direction[:5]
    np.testing.assert_allclose(saved.density(*at), gaze.density(*at), rtol=1e-3)


@pytest.mark.parametrize(
    "train",
    [
        lambda rays, output: train_gaze(rays, "none", output=output),
        lambda photos, output: train_radiance(photos, output=output),
    ],
)
def test_an_output_is_locked_during_training(tmp_path, train):
    with (
        reserve_output(tmp_path / "a.safetensors"),
        pytest.raises(NergError, match="wait until it has finished, or choose another"),
    ):
        train(tmp_path / "nothing", tmp_path / "a.safetensors")


# ---- Settings of a gaze training: valid combinations, and their values in the plan ----


SCENE = Environment(None, BOX, "scene")
VIEWS = {"rays": None, "environment": "none", "views": "photos", "salience": "maps"}


def change(name, options=None, settings=None, probes=None):
    """Return the recipe ``name`` with other options and settings."""
    recipe = get_recipe(name)
    options, settings, probes = (
        replace(part, **(changes or {}))
        for part, changes in ((recipe.options, options), (recipe.settings, settings), (recipe.probes, probes))
    )
    return replace(recipe, options=options, settings=settings, probes=probes)


@pytest.mark.parametrize(
    "arguments, said",
    [
        ({"environment": None}, 'environment="hits".*environment="none"'),
        ({"rays": None}, "there is no training data: give a rays file, or"),
        ({**VIEWS, "environment": "hits"}, "^environment need"),
        ({**VIEWS, "prior_folds": 2}, "^prior_folds need"),
        ({**VIEWS, "test_zones": 1}, "^test_zones need"),
        ({**VIEWS, "recipe": change("small", {"semantic": "snapshot"})}, "^the option semantic of the recipe need"),
        ({**VIEWS, "recipe": change("default", probes={"prior_kappa": 20.0})}, "^the prior_kappa of the recipe need"),
        ({**VIEWS, "rays": RAYS, "salience": None}, "saliency maps, or spectral-residual"),
        ({"align_views": "a.json"}, "saliency maps, or spectral-residual"),
        ({"align": "a.json"}, "align applies to a model"),
        ({"test_participants": 0.5}, "test_participants needs test positions: add"),
        ({"recipe": change("small", settings={"freeze": True})}, "freeze"),
        ({"recipe": change("default", settings={"loss": "paper"})}, 'use recipe="small"'),
        ({"recipe": change("default", settings={"integral_weight": 2.0})}, "the recipe default does not support"),
        ({"recipe": change("small", probes={"prior_kappa": 20.0})}, "the recipe small does not support"),
        ({"recipe": "small", "prior_folds": 2}, "the recipe small does not support"),
        ({"recipe": change("default", probes={"prior_kappa": 2000.0})}, "position-independent prior is stored in a"),
        ({"recipe": change("default", {"activation": "exp"})}, "the recipe default does not support"),
        ({"recipe": change("small", settings={"loss": "likelihood"})}, '"likelihood"'),
        ({"recipe": "large"}, "one of default, small, paper"),
        ({"variant": "both"}, 'variant must be "emit" or'),
        ({"recipe": change("small", {"semantic": "glance"})}, "of a gaze field must be one of accumulated,"),
        ({"environment": "none", "recipe": "small"}, "needs surfaces"),
    ],
)
def test_contradictory_arguments_are_refused(arguments, said):
    with pytest.raises(NergError, match=said) as error:
        train_gaze(**{"rays": RAYS, "environment": "hits", **arguments})
    # Options of a recipe are no keywords.
    assert set(error.value.parameters) <= set(inspect.signature(train_gaze).parameters)


@pytest.mark.parametrize("options", [{"init_from_field": True}, {"semantic": "snapshot"}])
def test_features_of_a_radiance_field_need_one(options):
    with pytest.raises(NergError, match="needs a radiance field; pass one as environment"):
        train_gaze(RAYS, "hits", recipe=change("small", options), voxel_size=0.3, min_rays=8, radius=0.5)


def test_a_field_starts_from_features_and_weights(tmp_path):
    radiance(tmp_path / "field.safetensors", density_scale=30.0)
    recipe = change("small", {"semantic": "snapshot", "init_from_field": True}, {"freeze": True})
    quick = {**QUICK, "steps": 4, "directions": 32, "output": tmp_path / "gaze.safetensors"}
    trained = train_gaze(looking_at((0.5, 0.1, 0.2), 300), tmp_path / "field.safetensors", recipe=recipe, **quick)
    assert trained.network.config.semantic == "snapshot" and trained.provenance["begins_as"] == "field.safetensors"
    assert trained.environment is not None and trained.environment.radiance is not None
    np.testing.assert_array_equal(
        np.array(trained.network.grid.table), np.array(trained.environment.radiance.network.grid.table)
    )


def test_every_setting_reaches_the_plan():
    values = {"steps": 7, "seed": 3, "validation_zones": 1, "radius": 0.4, "probes": 9, "min_rays": 4, "directions": 33}
    recipe = change("small", {"activation": "exp", "size": "paper", "normalized": True}, {"loss": "code"})
    plan = recipe.override(**values, minutes=None).make_plan(SCENE, "emit")
    names = {}
    for part in (plan.settings, plan.probes):
        names |= {f.name: getattr(part, f.name) for f in fields(part)}
    # The directions of a batch and of a probe are different settings.
    assert {name: names[name] for name in values} == values and plan.probes.directions == 33
    assert plan.settings.loss == "code" and recipe.override(minutes=2.0).settings.steps is None
    c = plan.config
    assert (c.variant, c.activation, c.grid.levels, c.normalized) == ("emit", "exp", 16, True)


def test_views_near_test_positions_are_left_out_in_scene_units():
    test = {"centres": [[1.0, 2.0, 1.5]], "rays_to_train": 5, "rays": 9, "people": []}
    near, far = (SimpleNamespace(camera=SimpleNamespace(center=np.array([10.0, 20, 15 + z]))) for z in (9.0, 11.0))
    scaled = Similarity(np.diag([10.0, 10, 10, 1]))
    assert module._leave_out_views((near, far), test, 1.0, scaled, Listener()) == (far,)


def test_views_alone_make_a_normalised_field():
    """Views have no total amount of gaze."""
    small = get_recipe("small")
    assert small.without_rays().make_plan(SCENE).config.normalized and not small.make_plan(SCENE).config.normalized


@pytest.mark.nightly
def test_trained_fields_can_be_rendered(rgb, tmp_path):
    import nerg_mi as nerg

    rng = np.random.default_rng(0)
    origin = rng.uniform((1, 1, 1.5), (2, 2, 1.6), (500, 3))
    direction = rng.normal(size=(500, 3)) * (1, 1, 0.2)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    rays = nerg.Rays(np.arange(500.0), np.zeros(500, int), ("Ada",), origin, direction, np.ones(500))
    field = nerg.train_gaze(rays, "none", steps=1, validation_zones=0, probes=4, output=tmp_path / "gaze.safetensors")
    assert field.name == "gaze.safetensors" and field.provenance["steps"] == 1
    again = nerg.GazeField.load(tmp_path / "gaze.safetensors")
    walls = {"type": "cube", "to_world": rgb.ScalarTransform4f().scale(4)}
    a, b = (
        nerg.trace(nerg.make_scene(gaze=g, shapes=walls), (1.5, 1.5, 1.5), [(1, 0, 0), (0, 1, 0.1)], "gaze").gaze
        for g in (field, again)
    )
    assert np.array_equal(a, b) and (a > 0).all()
