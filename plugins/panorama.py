r"""
.. _sensor-panorama:

Full-sphere panorama (:monosp:`panorama`)
-----------------------------------------

.. pluginparameters::

 * - to_world
   - |transform|
   - Position and orientation of the panorama: a rotation and a translation. Rays start at the image of the origin.
     (Default: none, i.e. sensor space = world space)
   - |exposed|

 * - shutter_open, shutter_close
   - |float|
   - Opening and closing time of the shutter, as for every sensor. (Default: 0)

 * - (Nested plugin)
   - :paramtype:`film`, :paramtype:`sampler`
   - The film may have any size of at least 1 x 2 pixels; 2 : 1 gives square pixels at the horizon. Crop windows and
     sample borders are supported.

This sensor sees all directions around a point, e.g. the gaze sphere of an observer at that point. Its mapping is the
exact inverse of that of the emitter :ref:`envmap <emitter-envmap>` with the same ``to_world``: a film of the size of
the environment map, sampled at its pixel centres, returns the map's pixels, and an image of this sensor can be used as
an ``envmap``.

In the sensor's frame +Y points up. Pixel coordinates :math:`(x, y)` on a film of :math:`W \times H` pixels correspond
to

.. math::

    v = (\sin\varphi\,\sin\theta,\; \cos\theta,\; -\cos\varphi\,\sin\theta), \qquad
    \varphi = \frac{2\pi x}{W}, \qquad \theta = \frac{\pi\,(y - 1/2)}{H - 1}

so that the middle column looks along +Z, like Mitsuba's cameras, and the centres of the first and the last row lie *at*
the poles, as in ``envmap``. Samples of these two rows beyond the pole continue on the opposite meridian.

The solid angle of a pixel is :math:`2\pi/W\,(\cos\theta_0 - \cos\theta_1)` between the borders of its row, clipped to
the sphere; the sum is :math:`4\pi`. ``nerg_mi.transport.geometry.pixel_solid_angles(W, H)`` returns it without a
variant, and the sensor's method ``pixel_solid_angles()`` for the crop window of its film.

Limitations: no near and far clipping plane, no aperture, and no light tracing (integrators such as ``ptracer``, which
connect light paths to the sensor, cannot use it).

.. tabs::
    .. code-tab:: xml
        :name: panorama-sensor

        <sensor type="panorama">
            <transform name="to_world">
                <lookat origin="1, 1.6, 2" target="1, 1.6, 3" up="0, 1, 0"/>
            </transform>
            <film type="hdrfilm">
                <integer name="width" value="256"/>
                <integer name="height" value="128"/>
                <rfilter type="box"/>
            </film>
        </sensor>

    .. code-tab:: python

        'type': 'panorama',
        'to_world': mi.ScalarTransform4f().look_at(origin=[1, 1.6, 2], target=[1, 1.6, 3], up=[0, 1, 0]),
        'film': {
            'type': 'hdrfilm', 'width': 256, 'height': 128,
            'rfilter': {'type': 'box'},
        }
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.maths.transforms import has_last_row
from nerg_mi.registration import register
from nerg_mi.transport.geometry import pixel_solid_angles

POLE = 1e-4
"""Minimum angle in radian between a ray and the panorama's axis."""


class Panorama(mi.Sensor):
    """A sensor for the full sphere around a point. The module's docstring is its manual page."""

    def __init__(self, props):
        super().__init__(props)
        # Otherwise integrators draw an unused aperture sample.
        self.m_needs_sample_3 = False
        self._check_to_world()
        self._check_film()

    # ------------------------------------------------------------------------
    #  Rays
    # ------------------------------------------------------------------------

    def sample_ray(self, time, sample1, sample2, sample3, active=True):
        wavelengths, weight = self._wavelengths(sample1, active)
        x = self._pixel(sample2)
        ray = mi.Ray3f(o=self._origin(), d=self._direction(x), time=time, wavelengths=wavelengths)
        return ray, weight

    def sample_ray_differential(self, time, sample1, sample2, sample3, active=True):
        wavelengths, weight = self._wavelengths(sample1, active)
        x = self._pixel(sample2)
        o = self._origin()
        ray = mi.RayDifferential3f(o=o, d=self._direction(x), time=time, wavelengths=wavelengths)
        ray.o_x, ray.d_x = o, self._direction(x + mi.Vector2f(1, 0))
        ray.o_y, ray.d_y = o, self._direction(x + mi.Vector2f(0, 1))
        ray.has_differentials = True
        return ray, weight

    def _pixel(self, sample: Any) -> Any:
        """Position on the whole film, in pixels, of a sample relative to the crop window."""
        film = self.film()
        size: Any = mi.Vector2f(film.crop_size())
        return mi.Point2f(sample) * size + mi.Vector2f(film.crop_offset())

    def _direction(self, pixel):
        """World direction of a position on the film; beyond a pole it continues on the opposite meridian."""
        # Not cached: the size of a film can change through mi.traverse.
        width, height = self.film().size()
        φ = pixel.x * (dr.two_pi / width)
        θ = (pixel.y - 0.5) * (dr.pi / (height - 1))
        # The pole itself has no longitude, so all pixels of the row would see the same pixel of an environment map.
        # With a tiny offset they keep their longitude; in single precision the polar angle is the same.
        θ = dr.select(abs(θ) < POLE, POLE, θ)
        θ = dr.select(abs(θ - dr.pi) < POLE, dr.pi - POLE, θ)
        sin_φ, cos_φ = dr.sincos(φ)
        sin_θ, cos_θ = dr.sincos(θ)
        return self.world_transform() @ mi.Vector3f(sin_φ * sin_θ, cos_θ, -cos_φ * sin_θ)

    def _origin(self):
        return self.world_transform() @ mi.Point3f(0)

    def _wavelengths(self, sample, active):
        return self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), sample, active)

    # ------------------------------------------------------------------------
    #  Properties
    # ------------------------------------------------------------------------

    def pixel_solid_angles(self) -> np.ndarray:
        """Solid angle in steradian of each pixel of the crop window: shape (crop height, crop width), float64."""
        film = self.film()
        (width, height), (x, y), (w, h) = film.size(), film.crop_offset(), film.crop_size()
        return pixel_solid_angles(width, height)[y : y + h, x : x + w]

    def bbox(self):
        box = mi.ScalarBoundingBox3f()
        box.expand(mi.ScalarPoint3f(*np.ravel(np.array(self._origin(), dtype=np.float64))))
        return box

    def traverse(self, callback):
        super().traverse(callback)
        callback.put("to_world", self.m_to_world, mi.ParamFlags.NonDifferentiable)

    def parameters_changed(self, keys=()):
        super().parameters_changed(keys)
        self._check_to_world()
        self._check_film()

    def to_string(self):
        film = str(self.film()).replace("\n", "\n  ")
        to_world = str(self.world_transform()).replace("\n", "\n  ")
        return f"Panorama[\n  to_world = {to_world},\n  film = {film},\n]"

    def _check_to_world(self):
        matrix = np.array(self.world_transform().matrix, dtype=np.float64).reshape(4, 4)
        turn = matrix[:3, :3]
        if not has_last_row(matrix[None])[0] or not np.allclose(turn.T @ turn, np.eye(3), atol=1e-3):
            # mi.Transform4f.rotate does not normalise its axis and gives a shear for an axis that is not a unit vector.
            raise NergError(
                '"to_world" of a panorama must be a rotation and a translation: remove its scale or shear, '
                "and give rotations an axis of unit length"
            )

    def _check_film(self):
        if self.film().size()[1] < 2:
            raise NergError('"height" of the film of a panorama must be at least 2 pixels, one for each pole')


register("sensor", "panorama", Panorama)
