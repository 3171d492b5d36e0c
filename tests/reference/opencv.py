"""OpenCV's camera models, restated from its documentation in plain float64 NumPy (calib3d: projectPoints,
undistortPoints, fisheye::projectPoints, fisheye::undistortPoints). The inverses iterate as OpenCV's do, but to
convergence."""

import numpy as np


def project(points, fx, fy, cx, cy, k):
    """Pixels (N, 2) of points (N, 3) before the camera (x right, y down, z forward); ``k``: k1 k2 p1 p2 k3 k4 k5 k6.

    Principal point as OpenCV counts it: the centre of the first pixel is (0, 0)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = k
    out = []
    for X, Y, Z in points:
        x, y = X / Z, Y / Z
        r2 = x**2 + y**2
        c = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
        xd = x * c + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
        yd = y * c + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
        out.append((fx * xd + cx, fy * yd + cy))
    return np.array(out)


def undistort(u, v, fx, fy, cx, cy, k, iterations=500):
    """Direction (x, y, 1) of a pixel: the fixed point of undistortPoints."""
    k1, k2, p1, p2, k3, k4, k5, k6 = k
    x0, y0 = (u - cx) / fx, (v - cy) / fy
    x, y = x0, y0
    for _ in range(iterations):
        r2 = x * x + y * y
        icdist = (1 + ((k6 * r2 + k5) * r2 + k4) * r2) / (1 + ((k3 * r2 + k2) * r2 + k1) * r2)
        dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        x, y = (x0 - dx) * icdist, (y0 - dy) * icdist
    return np.array([x, y, 1.0])


def fisheye_project(points, fx, fy, cx, cy, k):
    out = []
    for X, Y, Z in points:
        r = np.hypot(X, Y)
        theta = np.arctan2(r, Z)
        theta_d = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
        s = theta_d / r if r > 0 else 1.0
        out.append((fx * X * s + cx, fy * Y * s + cy))
    return np.array(out)


def fisheye_undistort(u, v, fx, fy, cx, cy, k):
    """Direction of a pixel, the angle found by bisection on [0, π]."""
    x, y = (u - cx) / fx, (v - cy) / fy
    r = np.hypot(x, y)
    low, high = 0.0, np.pi
    for _ in range(200):
        t = 0.5 * (low + high)
        if t * (1 + k[0] * t**2 + k[1] * t**4 + k[2] * t**6 + k[3] * t**8) < r:
            low = t
        else:
            high = t
    s = np.sin(low) / r if r > 0 else 1.0
    return np.array([x * s, y * s, np.cos(low)])
