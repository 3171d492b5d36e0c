"""The examples, at small sizes, and the notebooks."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from examples import aria_room, place_product
from examples import recover_observer as example
from tests.conftest import ROOT

# ---- Placing a product ----


@pytest.fixture(scope="module")
def shelf_run(tmp_path_factory):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    out = tmp_path_factory.mktemp("applications") / "shelf.png"
    return place_product.main(["--quick", "--out", str(out)]), out


@pytest.mark.nightly
def test01_optimum_equals_sweep(shelf_run):
    result, out = shelf_run
    at, values = result["sweep"]
    assert out.stat().st_size > 10_000 and values.min() > 0 and values.max() > 2 * values.min()
    for start, end, before, after, optimum, share in result["rows"]:
        assert after > before and abs(end - optimum) < 0.1 and share > 0.97, (start, end, optimum, share)


@pytest.mark.nightly
def test02_derivatives_equal_differences(shelf_run):
    checks = shelf_run[0]["checks"]
    automatic, central = checks[:, 3], checks[:, 4]
    assert np.allclose(automatic, central, rtol=0.05, atol=0.05 * np.abs(central).max())
    assert np.all((checks[:, 5] >= 0) & (checks[:, 5] < 0.05))


def test03_gradient_ascent():
    values = np.array([0, 1, 3, 2, 2.5, 4, 1, 0.0])
    assert place_product.uphill(values, 0, 1) == 2 and place_product.uphill(values, 0, 3) == 5
    assert place_product.uphill(values, 7, 2) == 5 and place_product.uphill(values, 5, 1) == 5


def test04_unknown_shelf_is_reported(rgb):
    with pytest.raises(SystemExit, match='no shelf "attic".*wall_cosmetics'):
        place_product.Shelf("attic")


# ---- Gaze in a real room ----


@pytest.mark.nightly
def test_gaze_of_glasses_ends_on_the_points_of_the_room(recorded, rgb, tmp_path):
    out = tmp_path / "room.png"
    share = aria_room.main([str(recorded("aria") / "gen1" / "mps_sample"), "--out", str(out), "--width", "96"])
    assert 0.7 < share < 0.9 and out.stat().st_size > 5000  # points have holes


# ---- Recovering an observer ----


def test05_image_distance():
    a = np.random.default_rng(0).exponential(1, (2, 16, 24))
    b, c = (np.roll(a, k, axis=2) for k in (1, 8))
    assert example.distance(a, a) == 0 and example.loss(a, a) == 0
    # Blocks of 8 pixels average out a shift by one pixel, but not by eight.
    assert 0 < example.distance(a, b) < example.distance(a, c) and example.loss(a, b) > 0
    assert np.allclose(example.pooled(a, 8), a.reshape(2, 2, 8, 3, 8).mean((2, 4)))
    assert example.distance(np.stack([a, b]), a).shape == (2,)


def test06_step_solves_linear_problem():
    """Logarithms are linear in the position: one damped step; pixels that are dark in either picture are ignored."""
    rng = np.random.default_rng(1)
    J, truth = rng.normal(0, 0.1, (2, 6, 8, 3)), np.array([0.1, -0.05, 0.02])
    now = rng.uniform(1, 2, (2, 6, 8))
    target = (now + example.FLOOR) * np.exp(J @ truth) - example.FLOOR
    slope = (now + example.FLOOR)[..., None] * J
    assert np.allclose(example.gauss_newton_step(now, slope, target, 1e3), truth, rtol=0.02, atol=1e-3)
    target[:, ::2] = 0
    now[:, :, ::3] = 0
    assert np.allclose(example.gauss_newton_step(now, slope, target, 1e3), truth, rtol=0.03, atol=2e-3)
    far = example.gauss_newton_step(now, slope * 0.01, target, 1e3)
    assert np.linalg.norm(far) <= example.LONGEST * 1.0001


@pytest.mark.nightly
def test07_observer_is_recovered(rgb):
    pictures, truth = example.Pictures((24, 16), cameras=example.CAMERAS[2:3]), np.array([4.4, 2.8, 1.6])
    start = truth + (0.1, 0.2, 0.05)
    derivatives = pictures.derivatives(truth)
    # Where all neighbouring pictures are bright, no edge passes, and derivatives equal differences of the pictures.
    # The distance is large enough for the discretisation of the integral over the sphere.
    h = 1e-2
    ends = [[pictures.at(truth + s * h * e) for s in (1, -1)] for e in np.eye(3)]
    differences = np.stack([(a - b) / (2 * h) for a, b in ends], -1)
    bend = np.max([np.abs(a + b - 2 * pictures.at(truth)) for a, b in ends], axis=0) / h
    smooth = bend < 0.02
    assert np.abs(differences[smooth]).max() > 0.1 and smooth.mean() > 0.5
    assert np.linalg.norm((derivatives - differences)[smooth]) < 0.1 * np.linalg.norm(differences[smooth])

    descent = example.descend(pictures, pictures.reference(truth, seed=1), start, 5)
    end, min_loss = descent.answer()
    assert np.linalg.norm(end - truth) < 0.5 * np.linalg.norm(start - truth) and min_loss < descent.losses[0]


def test08_positions_are_on_free_floor():
    for points, clearance in ((example.first_guesses(0.8), 0.15), (example.true_observers(5, 0), 0.22)):
        assert len(points) >= 5 and points.shape[1] == 3 and example.standing(points[:, :2], clearance).all()
    assert not np.array_equal(example.true_observers(5, 0), example.true_observers(5, 1))


# ---- Notebooks ----


def outputs(book) -> list[list[str]]:
    """Return the kinds of output of each cell, without progress bars, which are empty in the end."""
    is_bar = lambda output: output.get("data", {}).get("text/html") == ""
    return [
        [
            "+".join(sorted(o["data"])) if "data" in o else o.get("name", o.output_type)
            for o in cell.get("outputs", ())
            if not is_bar(o)
        ]
        for cell in book.cells
    ]


@pytest.mark.nightly
@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.ipynb")), ids=lambda p: p.stem)
def test_notebook_reproduces_stored_outputs(path, tmp_path):
    nbformat = pytest.importorskip("nbformat", reason="nbclient, of the extra test, is not installed")
    pytest.importorskip("ipykernel", reason="ipykernel, of the extra test, is not installed")
    from jupyter_client.manager import KernelManager
    from nbclient import NotebookClient

    book = nbformat.read(path, as_version=4)
    stored = outputs(book)
    # Over a Unix socket instead of a port, and with this Python regardless of installed kernels.
    kernel = KernelManager(transport="ipc", ip=str(tmp_path / "kernel"))
    kernel.kernel_spec.argv = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
    NotebookClient(book, km=kernel, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert outputs(book) == stored and any("image/png" in kind for cell in stored for kind in cell)
