"""Tests of `nerg_mi.photos.salience`."""

import json
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.files.images import write_bitmap_exr
from nerg_mi.photos import cameras
from nerg_mi.photos.cameras import Intrinsics, pixel_directions
from nerg_mi.photos.salience import open_salience, pixel_solid_angles, read_salience, spectral_residual
from tests.refusals import mentions

# ---- Solid angles of pixels, compared with closed forms for images, and with the Jacobian of each lens ----

PLAIN = Intrinsics(96, 64, 60.0, 55.0, 44.0, 30.5)
BARREL = replace(PLAIN, k1=-0.15, k2=0.03, p1=0.002, p2=-0.001)
FISHEYE = Intrinsics(96, 64, 40.0, 41.0, 47.0, 31.0, 0.02, -0.004, fisheye=True)


def corner(x, y):
    return np.arctan(x * y / np.sqrt(1 + x * x + y * y))


def test_a_pinholes_pixels_sum_to_its_frustum():
    i = PLAIN
    x, y = (np.array([0, i.width]) - i.cx) / i.fx, (np.array([0, i.height]) - i.cy) / i.fy
    expected = corner(x[1], y[1]) - corner(x[0], y[1]) - corner(x[1], y[0]) + corner(x[0], y[0])
    assert pixel_solid_angles(i).sum() == pytest.approx(expected, rel=1e-12)
    # Pixel by pixel.
    x, y = np.meshgrid((np.arange(97) - i.cx) / i.fx, (np.arange(65) - i.cy) / i.fy)
    f = corner(x, y)
    assert np.allclose(pixel_solid_angles(i), f[1:, 1:] - f[1:, :-1] - f[:-1, 1:] + f[:-1, :-1], rtol=1e-9)


@pytest.mark.parametrize("i", [PLAIN, BARREL, FISHEYE], ids=["pinhole", "barrel", "fisheye"])
def test_the_sum_is_that_of_the_border(i):
    """Between the axis and the border at azimuth φ, the solid angle per radian is 1 - cos θ(φ)."""
    n = 20000
    u, v = np.linspace(0, i.width, n, endpoint=False), np.linspace(0, i.height, n, endpoint=False)
    edge = np.concatenate(
        [
            np.stack(p, axis=-1)
            for p in ((u, 0 * u), (0 * v + i.width, v), (i.width - u, 0 * u + i.height), (0 * v, i.height - v))
        ]
    )
    d = cameras.image_to_directions((edge - [i.cx, i.cy]) / [i.fx, i.fy], i)
    phi, height = np.unwrap(np.arctan2(d[:, 1], d[:, 0])), 1 - d[:, 2]
    turn = np.diff(phi, append=phi[0] + 2 * np.pi)
    expected = np.sum(turn * 0.5 * (height + np.roll(height, -1)))
    assert pixel_solid_angles(i).sum() == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("widest", [np.radians(100), np.pi])
def test_a_fisheye_that_ends_within_the_picture_covers_a_cap(widest):
    # θ + k1 θ³ increases up to θ = (-3 k1)^-1/2; without k1, the complete sphere is in the image.
    i = Intrinsics(200, 200, 30.0, 30.0, 100.0, 100.0, 0.0 if widest == np.pi else -1 / (3 * widest**2), fisheye=True)
    solid = pixel_solid_angles(i)
    assert solid.sum() == pytest.approx(2 * np.pi * (1 - np.cos(widest)), rel=2e-3)
    assert (solid == 0).any() and (solid >= 0).all()


@pytest.mark.parametrize("i", [PLAIN, BARREL, FISHEYE], ids=["pinhole", "barrel", "fisheye"])
def test_a_pixel_has_the_jacobian_of_its_lens(i):
    fine = i.resized(3 * i.width, 3 * i.height)
    h = 1e-4
    x, y = np.meshgrid(
        (np.arange(fine.width) + 0.5 - fine.cx) / fine.fx, (np.arange(fine.height) + 0.5 - fine.cy) / fine.fy
    )
    ray = lambda dx, dy: cameras.image_to_directions(np.stack([x + dx, y + dy], axis=-1), i)
    across = np.cross(ray(h, 0) - ray(-h, 0), ray(0, h) - ray(0, -h)) / (4 * h * h)
    jacobian = np.linalg.norm(across, axis=-1) / (fine.fx * fine.fy)
    assert np.allclose(pixel_solid_angles(fine), jacobian, rtol=5e-4)
    if i is PLAIN:
        cos = -pixel_directions(fine)[..., 2]
        assert np.allclose(jacobian, cos**3 / (fine.fx * fine.fy), rtol=1e-6)


# ---- Spectral residual, compared with the published algorithm, implemented with a plain Fourier sum ----


def compute_reference(grey):
    h, w = grey.shape
    F = lambda n: np.exp(-2j * np.pi * np.outer(np.arange(n), np.arange(n)) / n)
    spectrum = F(h) @ grey @ F(w)
    amplitude = np.log(np.abs(spectrum))
    around = np.pad(amplitude, 1, mode="edge")
    mean = sum(around[a : a + h, b : b + w] for a in range(3) for b in range(3)) / 9
    back = F(h).conj() @ (np.exp(amplitude - mean) * spectrum / np.abs(spectrum)) @ F(w).conj() / (h * w)
    sharp = np.pad(np.abs(back) ** 2, 5)
    kernel = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 2.5**2))
    kernel = np.outer(kernel, kernel) / kernel.sum() ** 2
    return sum(kernel[a, b] * sharp[a : a + h, b : b + w] for a in range(11) for b in range(11))


def test_equals_published_algorithm():
    grey = np.random.default_rng(0).uniform(0.2, 0.8, (20, 32))
    grey[5:9, 20:25] = 1
    salience, expected = spectral_residual(np.repeat(grey[..., None], 3, axis=2)), compute_reference(grey)
    assert salience.shape == (20, 32) and salience.max() == 1
    assert np.allclose(salience, expected / expected.max(), atol=1e-4)


def test_odd_element_is_salient():
    x, y = np.meshgrid(np.arange(128), np.arange(96))
    photo = np.where((x // 8) % 2, 0.4, 0.6) * np.ones((96, 128))
    photo[40:48, 64:96] = np.where((y[40:48, 64:96] // 2) % 2, 0.4, 0.6)
    salience = spectral_residual(np.repeat(photo[..., None], 3, axis=2))
    assert salience.shape == (48, 64)
    v, u = np.unravel_index(np.argmax(salience), salience.shape)
    assert 17 <= v <= 27 and 28 <= u <= 52


# ---- Saliency maps: accepted and refused files, their frames, and their densities ----

LENSES = {
    "pinhole": {"fl_x": 40.0, "fl_y": 40.0},
    "barrel": {"fl_x": 40.0, "fl_y": 42.0, "cx": 30.0, "k1": -0.12, "k2": 0.02, "p1": 0.002},
    "fisheye": {"fl_x": 30.0, "fl_y": 30.0, "k1": 0.02, "camera_model": "OPENCV_FISHEYE"},
}


def write(path, values):
    import mitsuba as mi

    if path.suffix == ".npy":
        np.save(path, values)
    elif path.suffix == ".exr":
        write_bitmap_exr(path, mi.Bitmap(values))
    else:
        mi.Bitmap(values).write(str(path))
    return path


@pytest.fixture
def posed(tmp_path):
    """posed(names, **lens): a set of photos of 64 x 48 pixels, and the folder for their maps."""

    def make(names=("a", "b"), size=(48, 64), **keys):
        (tmp_path / "maps").mkdir()
        frames = []
        for k, name in enumerate(names):
            write(tmp_path / f"{name}.png", np.full((*size, 3), 99, np.uint8))
            pose = np.eye(4)
            pose[:3, :3], pose[0, 3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], k
            frames.append({"file_path": f"{name}.png", "transform_matrix": pose.tolist()})
        data = {"w": size[1], "h": size[0], **(keys or LENSES["pinhole"]), "frames": frames}
        (tmp_path / "transforms.json").write_text(json.dumps(data))
        return tmp_path

    return make


# ---- Files ----


def test_all_formats_give_same_map(tmp_path, rgb):
    values = np.arange(12).reshape(3, 4) * 5
    grey, byte = np.float32(values), values.astype(np.uint8)
    kinds = {
        "eight.png": byte,
        "sixteen.png": values.astype(np.uint16),
        "opaque.png": np.dstack([byte, byte, byte, 0 * byte + 255]),
        "three.png": np.dstack([byte, byte, byte]),
        "a.exr": grey,
        "three.exr": np.dstack([grey, grey, grey]),
        "a.npy": values / 60,
        "whole.npy": values,
        "column.npy": values[..., None],
        "flags.npy": values > 20,
    }
    for name, array in kinds.items():
        maps = read_salience(write(tmp_path / name, array))
        expected = (values > 20) if name == "flags.npy" else values
        assert np.allclose(maps / maps.sum(), expected / expected.sum(), atol=1e-7), name


@pytest.mark.parametrize(
    "name, values, said",
    [
        ("a.png", np.zeros((4, 4), np.uint8), "zero everywhere"),
        ("a.npy", np.full((4, 4), np.nan), "16 values that are not finite"),
        ("a.exr", np.array([[1, np.inf]], np.float32), "1 values that are not finite"),
        ("a.npy", np.array([[-1.0, 2]]), "log densities"),
        ("a.png", np.random.default_rng(0).integers(0, 255, (4, 4, 3)).astype(np.uint8), "has colours"),
        ("a.png", np.arange(1, 17, dtype=np.uint8).reshape(4, 4, 1) * np.ones(4, np.uint8), "partly transparent"),
        ("a.npy", np.ones((2, 3, 4, 5)), "one number per pixel"),
        ("a.npy", np.array([["x"]]), "one number per pixel"),
        *((name, None, f"{name}.*cannot be read") for name in ("a.png", "a.exr", "a.npy")),
    ],
)
def test_invalid_maps_are_refused(name, values, said, tmp_path, rgb):
    path = tmp_path / name
    if values is None:
        path.write_bytes(b"nonsense")
    else:
        write(path, values)
    with pytest.raises(ValueError, match=said) as e:
        read_salience(path)
    assert str(path) in str(e.value)


def test_maps_belong_to_frames_by_name(posed):
    folder = posed(("a", "b", "c"))
    write(folder / "maps" / "a.npy", np.ones((48, 64)))
    write(folder / "maps" / "c.png", np.ones((24, 32), np.uint8))
    write(folder / "maps" / "d.png", np.ones((24, 32), np.uint8))
    views = open_salience(folder, folder / "maps")
    assert (
        [v.name for v in views.views] == ["a.png", "c.png"]
        and views.frames_without_map == ["b.png"]
        and views.unmatched_files == ["d.png"]
    )
    assert views.views[1].gaze_fraction.shape == (24, 32) and np.allclose(views.views[1].camera.center, [2, 0, 0])
    assert views.provenance["used"] == 2 and views.provenance["missing"] == 1

    write(folder / "maps" / "a.png", np.ones((48, 64), np.uint8))
    with pytest.raises(ValueError, match='"a.npy" and "a.png"'):
        open_salience(folder, folder / "maps")


def test_map_of_wrong_shape_or_without_frame_is_refused(posed):
    folder = posed()
    with pytest.raises(ValueError, match='no file in .* expected "a"'):
        open_salience(folder, folder / "maps")
    with pytest.raises(FileNotFoundError, match="spectral-residual"):
        open_salience(folder, folder / "nothing")
    write(folder / "maps" / "b.npy", np.ones((32, 32)))
    with pytest.raises(ValueError, match="b.npy.*32.*32.*64.*48"):
        open_salience(folder, folder / "maps")
    with pytest.raises(ValueError, match="pixel or steradian"):
        open_salience(folder, folder / "maps", per="radian")


def test_map_of_two_photos_is_refused(posed):
    folder = posed(("one", "two"))
    for k in ("one", "two"):
        (folder / k).mkdir()
        (folder / f"{k}.png").rename(folder / k / "a.png")
    data = json.loads((folder / "transforms.json").read_text())
    for frame, k in zip(data["frames"], ("one", "two")):
        frame["file_path"] = f"{k}/a.png"
    (folder / "transforms.json").write_text(json.dumps(data))
    write(folder / "maps" / "a.npy", np.ones((48, 64)))
    with pytest.raises(ValueError, match="matches both"):
        open_salience(folder, folder / "maps")


# ---- Densities ----


def make_lens(keys):
    named = {k: v for k, v in keys.items() if k[0] in "kp"}
    return Intrinsics(
        64, 48, keys["fl_x"], keys["fl_y"], keys.get("cx", 32.0), 24.0, **named, fisheye="camera_model" in keys
    )


@pytest.mark.parametrize("name", LENSES)
def test_uniform_gaze_has_a_constant_density(name, posed):
    """For any lens: a map of ones per steradian, and a map of solid angles per pixel."""
    folder, solid = posed(("a",), **LENSES[name]), pixel_solid_angles(make_lens(LENSES[name]))
    for per, image in (("steradian", np.ones((48, 64))), ("pixel", solid)):
        write(folder / "maps" / "a.npy", image)
        view = open_salience(folder, folder / "maps", per).views[0]
        assert view.total_solid_angle == pytest.approx(solid.sum(), rel=1e-6)
        assert np.allclose(view.density, 1 / solid.sum(), rtol=1e-5)


@pytest.mark.parametrize("name", LENSES)
def test_samples_represent_equal_areas(name, posed):
    """The mean of a function over the samples is its mean over the image; here for a lobe, by fine quadrature."""
    folder = posed(("a",), **LENSES[name])
    write(folder / "maps" / "a.npy", np.ones((12, 16)))
    view = open_salience(folder, folder / "maps").views[0]
    directions, which = view.sample(4096, np.random.default_rng(0))
    assert np.allclose(np.linalg.norm(directions, axis=1), 1)
    counts = np.bincount(which, minlength=192)
    due = 4096 * (view.solid_angle / view.total_solid_angle).ravel()
    assert np.all(np.abs(counts - due) <= 1.01)
    axis = np.array([-0.95, 0.2, -0.1]) / np.linalg.norm([-0.95, 0.2, -0.1])
    lobe = lambda d: np.exp(8 * (d @ axis - 1))
    fine = make_lens(LENSES[name]).resized(256, 192)
    from nerg_mi.photos.cameras import pixel_directions

    world = pixel_directions(fine) @ view.camera.to_world[:3, :3].T
    expected = np.sum(lobe(world) * pixel_solid_angles(fine))
    assert view.total_solid_angle * lobe(directions).mean() == pytest.approx(expected, rel=0.01)


def test_density_is_evaluated_in_view(posed):
    folder = posed(("a",), **LENSES["barrel"])
    image = np.random.default_rng(3).uniform(0.1, 1, (48, 64))
    write(folder / "maps" / "a.npy", image)
    view = open_salience(folder, folder / "maps").views[0]
    directions, which = view.sample(500, np.random.default_rng(1))
    density, is_known = view.evaluate(directions)
    assert is_known.all() and np.allclose(density, view.density.ravel()[which], rtol=1e-5)
    # The camera looks along -x.
    assert not view.evaluate(np.array([[1.0, 0, 0], [0, 1, 0]]))[1].any()


def test_reduced_view_preserves_gaze(posed):
    folder = posed(("a",))
    image = np.random.default_rng(3).uniform(0, 1, (48, 64))
    write(folder / "maps" / "a.npy", image)
    view = open_salience(folder, folder / "maps").views[0]
    small = view.reduce(64 * 48 // 16)
    assert small.gaze_fraction.shape == (12, 16)
    assert np.allclose(small.gaze_fraction, view.gaze_fraction.reshape(12, 4, 16, 4).sum(axis=(1, 3)), rtol=1e-4)
    assert np.allclose(small.solid_angle, pixel_solid_angles(small.camera.intrinsics), rtol=1e-5)
    odd = view.reduce(200)
    assert (
        odd.gaze_fraction.size <= 200
        and odd.total_solid_angle == pytest.approx(view.total_solid_angle, rel=1e-5)
        and odd.gaze_fraction.sum() == pytest.approx(1)
    )


def test_masked_pixels_are_unknown(posed):
    folder = posed(("a",))
    mask = np.full((48, 64), 255, np.uint8)
    mask[:, :32] = 0
    write(folder / "mask.png", mask)
    data = json.loads((folder / "transforms.json").read_text())
    data["frames"][0]["mask_path"] = "mask.png"
    (folder / "transforms.json").write_text(json.dumps(data))
    write(folder / "maps" / "a.npy", np.ones((24, 32)))
    view = open_salience(folder, folder / "maps").views[0]
    assert (
        (view.solid_angle[:, :16] == 0).all()
        and (view.solid_angle[:, 16:] > 0).all()
        and (view.density[:, :16] == 0).all()
    )
    assert (view.sample(200, np.random.default_rng(0))[1] % 32 >= 16).all()
    write(folder / "maps" / "a.npy", np.tile(np.arange(32) < 10, (24, 1)))
    with pytest.raises(ValueError, match="a.npy.*mask"):
        open_salience(folder, folder / "maps")


def test_views_are_transformed(posed):
    folder = posed()
    write(folder / "maps" / "b.npy", np.ones((48, 64)))
    turn = np.diag([2.0, 2.0, 2.0, 1.0])
    turn[:3, 3] = 1, 2, 3
    view = open_salience(folder, folder / "maps", align=turn).views[0]
    assert np.allclose(view.camera.center, [3, 2, 3]) and np.allclose(view.camera.axis, [-1, 0, 0])


def test_model_computes_maps(posed, rgb):
    folder = posed(("a",))
    photo = np.random.default_rng(0).integers(90, 110, (48, 64, 3)).astype(np.uint8)
    photo[20:28, 40:48] = 250
    write(folder / "a.png", photo)
    view = open_salience(folder, "spectral-residual").views[0]
    y, x = np.unravel_index(np.argmax(view.gaze_fraction), view.gaze_fraction.shape)
    assert 16 <= y < 32 and 36 <= x < 52
    write(folder / "a.png", np.full((48, 64, 3), 90, np.uint8))
    with pytest.raises(ValueError, match="a.png.*one colour"):
        open_salience(folder, "spectral-residual")


def test_maps_outside_of_their_folder_are_used_only_if_allowed(posed):
    folder = posed(("a", "b"))
    write(folder / "elsewhere.npy", np.ones((48, 64)))
    (folder / "maps" / "a.npy").symlink_to(folder / "elsewhere.npy")
    with pytest.raises(NergError, check=mentions("allow_outside")):
        open_salience(folder, folder / "maps")
    assert len(open_salience(folder, folder / "maps", allow_outside=True).views) == 1
