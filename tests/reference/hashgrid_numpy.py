"""torch-ngp's hash grid kernel (gridencoder.cu, align_corners=False), re-stated in NumPy one point at a time.

Positions are float32 with one fused multiply-add, as nvcc compiles the kernel (float64 holds the product of
two float32 exactly, so that rounding once to float32 is the FMA); the interpolation is float64.
"""

import math

import numpy as np

PRIMES = (1, 2654435761, 805459861)


def rows_of_levels(levels, base, finest, log2_rows):
    """Rows allocated for each level: Python's float64 ``ceil(base s^l)``, one more vertex, rounded up to 8."""
    s = 2 ** (math.log2(finest / base) / (levels - 1)) if levels > 1 else 1.0
    out = []
    for level in range(levels):
        vertices = (math.ceil(base * s**level) + 1) ** 3
        out.append(math.ceil(min(2**log2_rows, vertices) / 8) * 8)
    return out


def scales_of_levels(levels, base, finest):
    """``exp2f(level S) H - 1`` in float32."""
    s = np.float32(math.log2(finest / base) / (levels - 1)) if levels > 1 else np.float32(0)
    return [np.exp2(np.float32(level) * s) * np.float32(base) - np.float32(1) for level in range(levels)]


def row_of_vertex(vertex, resolution, rows):
    """get_grid_index: dense while the stride fits, else the xor of the coordinates times primes (uint32)."""
    stride, index = 1, 0
    for c in vertex:
        if stride > rows:
            break
        index += c * stride
        stride *= resolution + 1
    if stride > rows:
        index = 0
        for c, prime in zip(vertex, PRIMES):
            index ^= (c * prime) & 0xFFFFFFFF
    return index % rows


def features(points, table, levels, features, log2_rows, base, finest):
    """(N, levels * features) at ``points`` (N, 3) of the unit cube; zero outside; ``table``: (rows, features)."""
    out = np.zeros((len(points), levels * features))
    offset = 0
    scales = scales_of_levels(levels, base, finest)
    for level, rows in enumerate(rows_of_levels(levels, base, finest, log2_rows)):
        scale = scales[level]
        resolution = math.ceil(scale) + 1
        for n, p in enumerate(np.asarray(points, np.float32)):
            if not np.all((p >= 0) & (p <= 1)):
                continue
            pos = (p.astype(np.float64) * np.float64(scale) + 0.5).astype(np.float32)
            cell = np.floor(pos)
            frac = (pos - cell).astype(np.float64)
            for corner in range(8):
                bits = [(corner >> axis) & 1 for axis in range(3)]
                weight = np.prod([f if b else 1 - f for f, b in zip(frac, bits)])
                vertex = [int(c) + b for c, b in zip(cell, bits)]
                row = offset + row_of_vertex(vertex, resolution, rows)
                out[n, level * features : (level + 1) * features] += weight * table[row]
        offset += rows
    return out
