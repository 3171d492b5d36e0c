"""The spectral residual against the authors' steps, written out with a plain Fourier sum."""

import numpy as np
import pytest

from nerg_mi.photos.salience import spectral_residual


def restated(grey):
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


def test_the_authors_steps():
    grey = np.random.default_rng(0).uniform(0.2, 0.8, (20, 32))
    grey[5:9, 20:25] = 1
    found, expected = spectral_residual(np.repeat(grey[..., None], 3, axis=2)), restated(grey)
    assert found.shape == (20, 32) and found.max() == 1
    assert np.allclose(found, expected / expected.max(), atol=1e-4)


def test_the_odd_one_out_is_salient():
    x, y = np.meshgrid(np.arange(128), np.arange(96))
    photo = np.where((x // 8) % 2, 0.4, 0.6) * np.ones((96, 128))
    photo[40:48, 64:96] = np.where((y[40:48, 64:96] // 2) % 2, 0.4, 0.6)
    found = spectral_residual(np.repeat(photo[..., None], 3, axis=2))
    assert found.shape == (48, 64)
    v, u = np.unravel_index(np.argmax(found), found.shape)
    assert 17 <= v <= 27 and 28 <= u <= 52


def test_one_colour_has_none():
    with pytest.raises(ValueError, match="one colour"):
        spectral_residual(np.full((8, 8, 3), 0.5))
