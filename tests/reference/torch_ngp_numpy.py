"""torch-ngp's and NeRG's networks and kernels, re-stated in NumPy float32 from their sources (gridencoder.cu,
network.py, raymarching.cu, gaze_prediction.py) on a state dictionary, with checkpoints of random weights to try them
on."""

import math

import numpy as np

from .fields_numpy import harmonics

F = np.float32
PRIMES = (1, 2654435761, 805459861)


# ---- gridencoder.cu ----------------------------------------------------------


def encode(x, embeddings, offsets, finest, bound):
    """Features (N, levels * F) at ``x`` (N, D) in [-bound, bound]; zeros outside."""
    x = (np.asarray(x, F) + F(bound)) / F(2 * bound)
    levels, dimensions = len(offsets) - 1, x.shape[1]
    s = F(np.log2(np.exp2(np.log2(finest / 16) / (levels - 1))))
    inside = np.all((x >= 0) & (x <= 1), axis=1)
    x = np.where(inside[:, None], x, F(0))
    out = []
    for level in range(levels):
        rows = int(offsets[level + 1] - offsets[level])
        scale = F(np.exp2(F(level) * s) * F(16) - F(1))
        resolution = math.ceil(scale) + 1
        # fmaf(x, scale, 0.5): float64 holds the product of two float32 exactly.
        pos = (x.astype(np.float64) * np.float64(scale) + 0.5).astype(F)
        cell = np.floor(pos).astype(np.uint32)
        frac = pos - cell.astype(F)
        total = np.zeros((len(x), embeddings.shape[1]), F)
        for corner in range(2**dimensions):
            w, vertex = np.ones(len(x), F), cell.copy()
            for axis in range(dimensions):
                if corner >> axis & 1:
                    w *= frac[:, axis]
                    vertex[:, axis] += 1
                else:
                    w *= F(1) - frac[:, axis]
            stride, index = 1, np.zeros(len(x), np.uint32)
            for axis in range(dimensions):
                if stride > rows:
                    break
                index += vertex[:, axis] * np.uint32(stride)
                stride *= resolution + 1
            if stride > rows:
                index = np.zeros(len(x), np.uint32)
                for axis in range(dimensions):
                    index ^= vertex[:, axis] * np.uint32(PRIMES[axis])
            total += w[:, None] * embeddings[offsets[level] + index % np.uint32(rows)]
        out.append(total)
    return np.concatenate(out, 1) * inside[:, None].astype(F)


# ---- network.py --------------------------------------------------------------


def linear_stack(h, state, name):
    names = sorted(k for k in state if k.startswith(name + "."))
    for i, k in enumerate(names):
        h = h @ state[k].T
        if i + 1 < len(names):
            h = np.maximum(h, 0)
    return h


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def sh(d):
    return harmonics(d).astype(F)


def nerf(state, bound, x, d):
    """``(sigma (N,), colour (N, 3), geo_feat (N, 15))`` of NeRFNetwork.forward."""
    h = linear_stack(
        encode(x, state["encoder.embeddings"], state["encoder.offsets"], 2048 * bound, bound), state, "sigma_net"
    )
    color = sigmoid(linear_stack(np.concatenate([sh(d), h[:, 1:]], 1), state, "color_net"))
    return np.exp(h[:, 0]), color, h[:, 1:]


def background(state, radius, o, d):
    """Colour (N, 3) of NeRFNetwork.background at sph_from_ray."""
    o, d = np.asarray(o, F), np.asarray(d, F)
    a, b, c = (d * d).sum(1), (o * d).sum(1), (o * o).sum(1) - F(radius) ** 2
    p = o + ((-b + np.sqrt(b * b - a * c)) / a)[:, None] * d
    theta, phi = np.arctan2(np.hypot(p[:, 0], p[:, 2]), p[:, 1]), np.arctan2(p[:, 2], p[:, 0])
    x = np.stack([2 * theta / F(math.pi) - 1, phi / F(math.pi)], 1).astype(F)
    h = encode(x, state["encoder_bg.embeddings"], state["encoder_bg.offsets"], 2048, 1)
    return sigmoid(linear_stack(np.concatenate([sh(d), h], 1), state, "bg_net"))


# ---- raymarching.cu ----------------------------------------------------------


def morton(x, y, z):
    def expand(v):
        v = np.asarray(v, np.uint32)
        for factor, mask in ((0x10001, 0xFF0000FF), (0x101, 0x0F00F00F), (0x11, 0xC30C30C3), (0x5, 0x49249249)):
            v = (v * np.uint32(factor)) & np.uint32(mask)
        return v

    return expand(x) | expand(y) << np.uint32(1) | expand(z) << np.uint32(2)


def occupied(bitfield, bound, x):
    """Whether the kernel marches at ``x`` (N, 3) with a short step: the bit of the least cascade that holds it."""
    x, h, cascades = np.asarray(x, F), 128, 1 + math.ceil(math.log2(bound))
    level = np.clip(np.frexp(np.abs(x).max(1))[1], 0, cascades - 1)
    half = np.minimum(np.exp2(level), bound).astype(F)
    n = np.clip(0.5 * (x / half[:, None] + 1) * h, 0, h - 1).astype(np.uint32)
    index = level.astype(np.int64) * h**3 + morton(n[:, 0], n[:, 1], n[:, 2])
    return bitfield[index // 8] >> (index % 8).astype(np.uint8) & 1 == 1


# ---- gaze_prediction.py ------------------------------------------------------


def layer_norm(x, gain, shift):
    m = x.mean(1, keepdims=True)
    return (x - m) / np.sqrt(((x - m) ** 2).mean(1, keepdims=True) + F(1e-5)) * gain + shift


def gaze_net(h, state, name):
    if f"{name}.lin0.weight" not in state:
        return np.maximum(h @ state[f"{name}.0.weight"].T, 0) @ state[f"{name}.3.weight"].T
    for i in range(2):
        h = layer_norm(h, state[f"{name}.layernorm{i}.weight"], state[f"{name}.layernorm{i}.bias"])
        h = np.maximum(h @ state[f"{name}.lin{i}.weight"].T + state[f"{name}.lin{i}.bias"], 0)
    return h


def gaze(state, bound, p_od, p_o, r_o, variant="EmitCapture"):
    """``(gaze, emit, capture)`` of NeRGRenderer.forward; behind the grid in float64: LayerNorm amplifies rounding."""
    state = {k: v.astype(np.float64) if k.endswith(("weight", "bias")) else v for k, v in state.items()}

    def trunk(x, d):
        h = gaze_net(
            encode(x, state["encoder.embeddings"], state["encoder.offsets"], 256 * bound, bound), state, "net1"
        )
        return gaze_net(np.concatenate([sh(d), h], 1), state, "net2")

    one = np.ones(len(p_od), F)
    emit = (trunk(p_od, -r_o) @ state["emit_head.weight"].T)[:, 0] if "Emit" in variant else one
    capture = sigmoid((trunk(p_o, r_o) @ state["capture_head.weight"].T)[:, 0]) if "Capture" in variant else one
    return emit * capture, emit, capture


# ---- checkpoints of random weights --------------------------------------------


def offsets(levels, finest, dimensions=3):
    out, s = [0], np.exp2(np.log2(finest / 16) / (levels - 1))
    for level in range(levels):
        rows = min(2**19, (int(np.ceil(16 * s**level)) + 1) ** dimensions)
        out.append(out[-1] + int(np.ceil(rows / 8) * 8))
    return np.array(out, np.int32)


def table(rows, rng, scale=1.0):
    """Uniform numbers of unit variance: quick to make in the sizes of the paper."""
    return (rng.random((rows, 2), dtype=F) * F(2) - F(1)) * F(scale * 3**0.5)


def matrix(rng, rows, columns, scale=1.0):
    return (rng.normal(size=(rows, columns)) * scale / np.sqrt(columns)).astype(F)


def nerf_state(bound, rng, with_background=False, filled=0.3):
    """State dictionary of a NeRF of the paper's sizes."""
    where, cascades = offsets(16, 2048 * bound), 1 + math.ceil(math.log2(bound))
    cube = np.array([-bound] * 3 + [bound] * 3, F)
    state = {
        "aabb_train": cube,
        "aabb_infer": cube.copy(),
        "density_bitfield": np.packbits(rng.random(cascades * 128**3, dtype=F) < filled, bitorder="little"),
        "step_counter": np.zeros((16, 2), np.int32),
        "encoder.embeddings": table(where[-1], rng),
        "encoder.offsets": where,
        "sigma_net.0.weight": matrix(rng, 64, 32),
        "sigma_net.1.weight": matrix(rng, 16, 64, 2),
        "color_net.0.weight": matrix(rng, 64, 31),
        "color_net.1.weight": matrix(rng, 64, 64),
        "color_net.2.weight": matrix(rng, 3, 64, 2),
    }
    if with_background:
        behind = offsets(4, 2048, 2)
        state |= {
            "encoder_bg.embeddings": table(behind[-1], rng),
            "encoder_bg.offsets": behind,
            "bg_net.0.weight": matrix(rng, 64, 24),
            "bg_net.1.weight": matrix(rng, 3, 64, 2),
        }
    return state


def gaze_state(bound, rng, variant="EmitCapture", layernorm=True):
    """State dictionary of a gaze field of the authors' sizes, without its NeRF."""
    where = offsets(16, 256 * bound)
    state = {
        "aabb_train": np.array([-bound] * 3 + [bound] * 3, F),
        "encoder.embeddings": table(where[-1], rng),
        "encoder.offsets": where,
    }
    for name, sizes in (("net1", (32, 64, 15)), ("net2", (31, 64, 64))):
        for i, (columns, rows) in enumerate(zip(sizes, sizes[1:])):
            if layernorm:
                state |= {
                    f"{name}.layernorm{i}.weight": rng.uniform(0.5, 1.5, columns).astype(F),
                    f"{name}.layernorm{i}.bias": rng.normal(0, 0.2, columns).astype(F),
                    f"{name}.lin{i}.weight": matrix(rng, rows, columns),
                    f"{name}.lin{i}.bias": rng.normal(0, 0.2, rows).astype(F),
                }
            else:
                state[f"{name}.{3 * i}.weight"] = matrix(rng, rows, columns)
    for head in ("Emit", "Capture"):
        if head in variant:
            state[f"{head.lower()}_head.weight"] = matrix(rng, 1, 64)
    return state
