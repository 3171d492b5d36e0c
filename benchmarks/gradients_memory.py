"""Peak memory, in MB, that a derivative of a picture adds to a process; see ``gradients.py``.

    python benchmarks/gradients_memory.py ours|plain SAMPLES

64 x 64 rays through a field, colour and opacity with respect to all weights. ``ours``: ``mi.render`` and its derivative.
``plain``: the same samples, all at once, differentiated by Dr.Jit. A first pass over few rays has compiled the kernels.
"""

from __future__ import annotations

import gc
import sys
import tempfile
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit)
import drjit as dr
import mitsuba as mi

SIZE = 64


def peak() -> tuple[float, float]:
    """Resident memory now and at most, in MB."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return tuple(float(lines[k].split()[0]) / 1024 for k in ("VmRSS", "VmHWM"))


def ours(scene, integrator, size: int) -> None:
    params = mi.traverse(scene)
    for key in list(params.keys()):
        if key.startswith("integrator.field."):
            dr.enable_grad(params[key])
    params.update()
    sensor = scene.sensors()[size == SIZE]
    dr.backward(dr.sum(mi.render(scene, params, sensor=sensor, spp=1), axis=None))
    dr.eval(dr.grad(params["integrator.field.grid.table"]))


def plain(scene, integrator, size: int) -> None:
    medium = integrator.medium
    for value in medium.field.parameters().values():
        dr.enable_grad(value)
    medium.field.pack()
    rays = size * size
    n = round(2 / integrator.settings.step)
    index = dr.arange(mi.UInt32, rays * n)
    ray, k = index // n, index % n
    x, y = (mi.Float(ray % size) + 0.5) / size, (mi.Float(ray // size) + 0.5) / size
    p = mi.Point3f(2 * x - 1, 2 * y - 1, -1 + (mi.Float(k) + 0.5) * (2 / n)) * 0.999
    sigma, features = medium.density_features(p, True)
    tau = sigma * (2 / n)
    weight = dr.exp(-dr.block_prefix_sum(tau, n)) * (1 - dr.exp(-tau))
    color = medium.color(features, p, mi.Vector3f(0, 0, 1), True)
    dr.backward(dr.sum(weight * (color.x + color.y + color.z + 1)))
    dr.eval(dr.grad(medium.field.grid.table))


def main(how: str, samples: int) -> None:
    mi.set_variant("llvm_ad_rgb")
    import gradients_cases as g

    with tempfile.TemporaryDirectory() as folder:
        g.write_fields(mi, Path(folder))
        field = {"type": "nerf", "filename": str(Path(folder) / "field.safetensors")}
        integrator = {"type": "nerg", "field": field, "step": 2 / samples, "stop": 0.0, "color_cutoff": 0.0, "aovs": "opacity"}
        sensors = {f"sensor{size}": {
            "type": "orthographic", "to_world": g.look_at(mi, (0, 0, -3)),
            "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
        } for size in (4, SIZE)}  # fmt: skip
        scene = mi.load_dict({"type": "scene", "integrator": integrator, **sensors})
    run = {"ours": ours, "plain": plain}[how]
    run(scene, scene.integrator(), 4)
    dr.sync_thread()
    gc.collect()
    dr.flush_malloc_cache()
    Path("/proc/self/clear_refs").write_text("5")
    before, _ = peak()
    run(scene, scene.integrator(), SIZE)
    dr.sync_thread()
    print(f"{peak()[1] - before:,.0f}")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
