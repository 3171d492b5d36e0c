"""Tests of `nerg_mi.fields.gaze_base`."""

from __future__ import annotations

from dataclasses import replace

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields import gaze_base
from nerg_mi.fields.gaze_base import (
    CUTOFF_RADII,
    DataSummary,
    GazeEnsemble,
    RaySupport,
    summarize_provenance,
    tracking_suffix,
)
from nerg_mi.fields.gaze_hits import HitKernel, ReaimedHits
from nerg_mi.fields.gaze_log_density import LogGazeField
from nerg_mi.fields.gaze_product import GazeConfig, ProductHead
from nerg_mi.fields.mlp import namespace
from nerg_mi.formats.fields import load_gaze, save_gaze
from nerg_mi.maths.geometry import Box
from tests.fields.gaze.test_log_density import BOX, GRID, SMALL, made

# ---- Amount of training data, in words and in checkpoints ----


@pytest.mark.parametrize(
    ("basis", "words"),
    [
        (DataSummary(81_751, 100), "81,751 rays of 100 participants"),
        (DataSummary(1, 1), "1 ray of 1 participant"),
        (DataSummary(300), "300 rays"),
        (DataSummary(300, 3, 1), "300 rays of 3 participants and 1 salience image"),
        (DataSummary(0, None, 12), "12 salience images"),
        (DataSummary(0), ""),
        (DataSummary(300, 3, tracking="eye"), "300 rays of 3 participants"),
        (DataSummary(300, 3, 1, "head"), "300 rays of 3 participants (directions of heads) and 1 salience image"),
        (DataSummary(300, tracking="mixed"), "300 rays (partly directions of heads)"),
    ],
)
def test_describe_counts(basis, words):
    assert basis.words() == words


def test_summary_from_checkpoint():
    assert summarize_provenance({"rays": 5, "people": 2, "salience_views": 0}) == DataSummary(5, 2)
    # Checkpoints of earlier versions have no number of participants, and those of views have no rays.
    assert summarize_provenance({"rays": 5}) == DataSummary(5)
    assert summarize_provenance({"rays": 0, "people": 0, "salience_views": 3}) == DataSummary(0, None, 3)
    assert summarize_provenance({"made": "random"}) is None


def test_tracking_from_checkpoint():
    for kind in ("eye", "head", "mixed"):
        basis = summarize_provenance({"rays": 5, "tracking": kind})
        assert basis is not None and basis.tracking == kind
        assert bool(tracking_suffix({"tracking": kind})) == (kind != "eye")
    for other in ({}, {"tracking": "hand"}, {"tracking": ["head"]}, {"tracking": None}):
        basis = summarize_provenance({"rays": 5, **other})
        assert basis is not None and basis.tracking == "unknown" and not tracking_suffix(other)


@pytest.mark.parametrize("value", [-1, 1e300, "5", [5], True, None, 1 << 70, float("nan")])
def test_invalid_counts_are_ignored(value):
    assert summarize_provenance({"rays": value}) is None and summarize_provenance(
        {"rays": 7, "people": value}
    ) == DataSummary(7)


# ---- Kinds of gaze fields by their names in checkpoints ----


def fields():
    ns = namespace("llvm")
    log = [LogGazeField.random(SMALL, BOX, ns, seed) for seed in (1, 2)]
    return {
        "product": ProductHead.random(GazeConfig(GRID, width=16), BOX, ns),
        "log_density": log[0],
        "ensemble": GazeEnsemble(log),
    }


@pytest.mark.parametrize("kind", ["product", "log_density", "ensemble"])
def test_registered_kinds(kind):
    """Registered for any import order; each architecture builds the same field."""
    field = fields()[kind]
    assert field.kind == kind in gaze_base.kinds() and field.architecture().get("kind", "product") == kind
    assert (len(field.members) == 1) == (field.members[0] is field) == (kind != "ensemble")
    assert field.networks == (4 if kind == "ensemble" else 2)


@pytest.mark.parametrize("kind", ["wavelet", ["product"], 3])
def test_unknown_kind_is_refused(kind):
    with pytest.raises((ValueError, TypeError), match="wavelet|kind|unhashable"):
        gaze_base.build_gaze_field({"kind": kind}, BOX, None)


# ---- Support near a position: cells against the sum over all rays ----


def exact(origins, radius, p, scale=CUTOFF_RADII):
    return np.maximum(1 - ((origins - p) ** 2).sum(axis=1) / (scale * radius) ** 2, 0).sum()


def at(support, p):
    return float(support.evaluate(ns.Array3f(*map(float, p)))[0])


def paths(n=20_000, seed=0):
    """Participants who walk through a hall and stop occasionally."""
    rng = np.random.default_rng(seed)
    walk = np.cumsum(rng.normal(0, 0.03, (n, 2)) * (rng.random((n, 1)) < 0.5), axis=0) % 4
    return np.concatenate([walk, rng.normal(1.6, 0.08, (n, 1))], axis=1)


def test_densest_position():
    rng = np.random.default_rng(0)
    origins = np.concatenate([rng.normal(c, 0.05, (n, 3)) for c, n in (((0, 0, 1), 400), ((3, 1, 2), 900))])
    support = RaySupport.from_origins(origins, 0.3)
    densest = support.find_densest_position()
    assert np.linalg.norm(densest - (3, 1, 2)) < 0.1
    everywhere = [exact(origins, 0.3, p, 1) for p in origins[::7]]
    assert exact(origins, 0.3, densest, 1) > 0.9 * max(everywhere)


@pytest.mark.parametrize("radius", [0.1, 0.6])
def test_cells_approximate_their_rays(radius):
    origins = paths()
    support = RaySupport.from_origins(origins, radius)
    assert support.cells[:, 3].sum() == len(origins) and len(support.cells) < len(origins)
    rng = np.random.default_rng(1)
    places = np.concatenate([origins[rng.integers(0, len(origins), 200)], rng.uniform(-6, 10, (100, 3))])
    result, expected = (
        np.array([f(p) for p in places]) for f in (lambda p: at(support, p), lambda p: exact(origins, radius, p))
    )
    many = expected >= 5
    assert many.sum() > 100 and (expected == 0).sum() > 20
    off = np.abs(result / np.where(many, expected, 1) - 1)[many]
    assert np.percentile(off, 95) < 0.04 and np.median(off) < 0.01
    assert np.abs(result - expected)[~many].max() < 4


def test_cells_inside_the_cutoff_are_exact():
    origins = np.random.default_rng(0).normal(0, 0.05, (1000, 3))
    support = RaySupport.from_origins(origins, 1.0)
    assert at(support, (1.2, 2.1, 0)) == pytest.approx(exact(origins, 1.0, [1.2, 2.1, 0]), rel=1e-5)


def test_single_ray_has_support_one_at_its_origin_and_zero_at_five_radii():
    support = RaySupport.from_origins([[1.0, 2, 3]], 0.5)
    assert at(support, (1, 2, 3)) == 1 and at(support, (3.5, 2, 3)) < 1e-6
    assert at(support, (1, 2, 4.25)) == pytest.approx(0.75)
    assert support.cutoff == pytest.approx(2.5)


def test_invalid_support_is_refused():
    for cells, radius in (([[0, 0, 0, 1, np.nan]], 1.0), ([[0, 0, 0, 1, 0]], 0.0)):
        with pytest.raises(ValueError, match="finite cells and a positive radius"):
            RaySupport(np.array(cells), radius)


# ---- Ensembles of gaze fields: compatible members, arrays, files ----


def test_members_must_match():
    with pytest.raises(ValueError, match="at least two"):
        GazeEnsemble([made()])
    other_box = LogGazeField.random(SMALL, Box((0, 0, 0), (1, 1, 1)), namespace("llvm"))
    for other in (made(replace(SMALL, variant="emit")), made(replace(SMALL, escaped="nearest")), other_box):
        with pytest.raises(ValueError, match="train them alike"):
            GazeEnsemble([made(), other])
    # The box of observers can differ between members.
    GazeEnsemble([made(), made(replace(SMALL, heads=((0, 0, 1), (1, 1, 2))))])


def test_parameters_of_members_are_prefixed():
    ensemble = GazeEnsemble([made(seed=1), made(seed=2)])
    before = {k: np.array(v) for k, v in ensemble.parameters().items()}
    assert len(before) == 2 * len(made().parameters())
    assert not np.array_equal(before["0.grid.table"], before["1.grid.table"])
    ensemble.set_parameters({"1.grid.table": ensemble.parameters()["1.grid.table"] * 0})
    after = {k: np.array(v) for k, v in ensemble.parameters().items()}
    assert not after["1.grid.table"].any()
    assert all(np.array_equal(before[k], after[k]) for k in before if k != "1.grid.table")


@pytest.mark.parametrize("half", [False, True])
def test_file_stores_all_members_and_support(half, tmp_path):
    """Counts and positions are never rounded to fp16."""
    members = [made(seed=1), made(replace(SMALL, heads=((0, 0, 1), (1, 1, 2))), seed=2)]
    support = RaySupport.from_origins(np.random.default_rng(0).uniform(0, 9, (5000, 3)), 0.25)
    save_gaze(GazeEnsemble(members, support), tmp_path / "g.safetensors", {"made": "here"}, half)
    again, meta = load_gaze(tmp_path / "g.safetensors", namespace("llvm"))
    assert meta["provenance"] == {"made": "here"} and meta["output"] == {"activation": "log", "normalized": True}
    assert [m.config for m in again.members] == [m.config for m in members] and again.box == members[0].box
    for name, value in GazeEnsemble(members).parameters().items():
        np.testing.assert_allclose(
            np.array(again.parameters()[name]), np.array(value), rtol=1e-3 if half else 0, atol=1e-3 if half else 0
        )
    np.testing.assert_array_equal(again.support.cells, support.cells)
    assert again.support.radius == 0.25  # noqa: RUF069 (stored)


def test_nested_ensembles_are_refused(tmp_path):
    """On construction and in files, for any nesting depth."""
    pair = GazeEnsemble([made(seed=1), made(seed=2)])
    for members in ([pair, pair], [made(), pair]):
        with pytest.raises(ValueError, match="give its members instead"):
            GazeEnsemble(members)
    metadata = pair.architecture()
    for _ in range(500):
        metadata = {"kind": "ensemble", "members": [metadata, metadata]}
    with pytest.raises(ValueError, match="is an ensemble itself, which this version does not read"):
        gaze_base.build_gaze_field(metadata, pair.box, NoArrays())


def test_members_have_no_hits_of_their_own():
    """They would be lost, because an ensemble mixes in its own."""
    member = made()
    member.hits = ReaimedHits(np.zeros((1, 3)), np.ones((1, 3)), [HitKernel(0.5, 0.4, 50.0)])
    with pytest.raises(ValueError, match="reaimed_hits=False"):
        GazeEnsemble([member, made(seed=1)])


class NoArrays:
    """Arrays of an empty file."""

    def get_member(self, index, architecture):
        return architecture, self
