"""Peak memory of a derivative in reverse mode against the number of samples a ray.

    python benchmarks/gradients_memory.py [--samples 16,64,256,1024] [--update docs/gradients.md]

64 x 64 rays through the small fields of ``gradients_cases.py``; each figure is of a process of its own and says how
many MB of arrays Dr.Jit held at most during the derivative, beyond what it held before (``malloc_watermark``). A first
derivative over 4 x 4 rays has compiled the kernels. Nothing passes or fails here.

``field``: ``mi.render`` of colour, depth and opacity with respect to all weights of the radiance field. ``everything``:
all AOVs, an observer who marches the field, with respect to all weights of both fields. ``stored``: colour and opacity
from as many samples of the radiance field, all at once, differentiated by Dr.Jit in one piece.
"""

from __future__ import annotations

import argparse
import gc
import subprocess
import sys
import tempfile
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit)
from output import print_table

import drjit as dr
import mitsuba as mi

SIZE, WARM = 64, 4
COLUMNS = {"field": "field, MB", "everything": "everything, MB", "stored": "stored samples, MB"}


def rendered(scene, integrator, size: int) -> None:
    """Reverse mode through ``mi.render``, of all channels with respect to all weights."""
    params = mi.traverse(scene)
    weights = [key for key in params.keys() if key.startswith(("integrator.field.", "integrator.gaze."))]
    for key in weights:
        dr.enable_grad(params[key])
    params.update()
    sensor = scene.sensors()[size == SIZE]
    dr.backward(dr.sum(mi.render(scene, params, sensor=sensor, spp=1), axis=None))
    dr.eval([dr.grad(params[key]) for key in weights])


def stored(scene, integrator, size: int) -> None:
    """Reverse mode of Dr.Jit through all samples at once."""
    medium = integrator.medium
    for value in medium.field.parameters().values():
        dr.enable_grad(value)
    medium.field.pack()
    n = round(2 / integrator.settings.step)
    index = dr.arange(mi.UInt32, size * size * n)
    ray, k = index // n, index % n
    x, y = (mi.Float(ray % size) + 0.5) / size, (mi.Float(ray // size) + 0.5) / size
    p = mi.Point3f(2 * x - 1, 2 * y - 1, -1 + (mi.Float(k) + 0.5) * (2 / n)) * 0.999
    sigma, features = medium.density_features(p, True)
    tau = sigma * (2 / n)
    weight = dr.exp(-dr.block_prefix_sum(tau, n)) * (1 - dr.exp(-tau))
    color = medium.color(features, p, mi.Vector3f(0, 0, 1), True)
    dr.backward(dr.sum(weight * (color.x + color.y + color.z + 1)))
    dr.eval([dr.grad(value) for value in medium.field.parameters().values()])


def scene_of(g, folder: Path, how: str, samples: int):
    """A camera whose parallel rays all cross the field's box, ``samples`` steps deep."""
    more = {} if how == "everything" else {"gaze": None, "observer": None, "aovs": "depth,opacity"}
    field = {"type": "nerf", "filename": str(folder / "field.safetensors")}
    integrator = g.integrator(mi, folder, field=field, step=2 / samples, stop=0.0) | more
    sensors = {
        f"sensor{size}": {**g.camera(mi, size=size), "type": "orthographic", "to_world": g.look_at(mi, (0, 0, -3))}
        for size in (WARM, SIZE)
    }
    for sensor in sensors.values():
        del sensor["fov"]
    return mi.load_dict(
        {"type": "scene", "integrator": {k: v for k, v in integrator.items() if v is not None}, **sensors}
    )


def peak(how: str, samples: int) -> float:
    """What one derivative adds at most to what is held before, in MB (of 10^6 bytes)."""
    import gradients_cases as g

    mi.set_variant("llvm_ad_rgb")
    with tempfile.TemporaryDirectory() as folder:
        g.write_fields(mi, Path(folder))
        scene = scene_of(g, Path(folder), how, samples)
    run = stored if how == "stored" else rendered
    run(scene, scene.integrator(), WARM)
    gc.collect()
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    before = dr.detail.malloc_watermark(dr.JitBackend.LLVM)
    run(scene, scene.integrator(), SIZE)
    dr.sync_thread()
    return (dr.detail.malloc_watermark(dr.JitBackend.LLVM) - before) / 1e6


def measured(samples: int) -> list[str]:
    """A row of the table, each figure of its own process."""
    row = [f"{samples:,}"]
    for how in COLUMNS:
        command = [sys.executable, __file__, "--one", how, "--samples", str(samples)]
        row.append(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.strip())
    print(row, file=sys.stderr, flush=True)
    return row


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", default="16,64,256,1024", help="comma-separated numbers of samples a ray")
    parser.add_argument("--one", choices=COLUMNS, help="print one figure, measured in this process")
    parser.add_argument("--update", type=Path, help="a document whose table is replaced")
    args = parser.parse_args(argv)
    counts = [int(n) for n in args.samples.split(",")]
    if args.one:
        print("\n".join(f"{peak(args.one, n):,.1f}" for n in counts))
        return
    print_table("Peak memory", ["samples a ray", *COLUMNS.values()], [measured(n) for n in counts], args.update)


if __name__ == "__main__":
    main()
