"""Readers of fields and of training states."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np

from tests.fuzz.watch import Reader

_METADATA = {"sha": 1, "width": 24}


def _parts():
    from drjit.llvm import ad as ns

    from nerg_mi.fields.encoding import HashGridConfig
    from nerg_mi.maths.geometry import Box

    return ns, Box((-1, 0, 2), (3, 2, 4)), HashGridConfig(levels=2, log2_rows=3, base=2, finest=4)


def _make_radiance(folder: Path) -> None:
    from nerg_mi.fields.encoding import HashGridConfig
    from nerg_mi.fields.occupancy import OccupancyGrid
    from nerg_mi.fields.radiance import Background, BackgroundConfig, RadianceConfig, RadianceNetwork
    from nerg_mi.formats.fields import save_radiance

    ns, box, grid = _parts()
    config = RadianceConfig(grid, width=4, color_hidden=1, geometry=3, sh_degree=2)
    behind = BackgroundConfig(8.0, HashGridConfig(levels=1, log2_rows=3, base=2, finest=4, dimensions=2), 4, 1, 2)
    field = RadianceNetwork.random(
        config,
        box,
        ns,
        1,
        occupancy=OccupancyGrid(np.eye(4, dtype=bool)[None].repeat(4, 0), ns, 0.25),
        march_step=0.01,
        background=Background.random(behind, ns),
    )
    save_radiance(field, folder / "field.safetensors", {"dataset": "here", "width": 8, "to_file": np.eye(4).tolist()})


def _read_radiance(folder: Path) -> object:
    from nerg_mi.formats.fields import load_radiance

    return load_radiance(folder / "field.safetensors", _parts()[0])


def _gaze(kind: str):
    from nerg_mi.fields.gaze_base import GazeEnsemble, RaySupport
    from nerg_mi.fields.gaze_log_density import LogGazeConfig, LogGazeField
    from nerg_mi.fields.gaze_product import GazeConfig, ProductHead

    ns, box, grid = _parts()
    if kind == "product":
        return ProductHead.random(GazeConfig(grid, width=4, geometry=3, sh_degree=2, trunk="layernorm"), box, ns, 2)
    one = lambda seed: LogGazeField.random(LogGazeConfig(grid, width=4, layers=1, sh_degree=2, prior=2), box, ns, seed)
    field = one(1) if kind == "log" else GazeEnsemble([one(1), one(2)])
    field.support = RaySupport.from_origins(np.random.default_rng(0).random((9, 3)), 0.5)
    return field


def _make_gaze(kind: str):
    def make(folder: Path) -> None:
        from nerg_mi.formats.fields import save_gaze

        save_gaze(_gaze(kind), folder / "gaze.safetensors", {})

    return make


def _read_gaze(folder: Path) -> object:
    from nerg_mi.formats.fields import load_gaze

    return load_gaze(folder / "gaze.safetensors", _parts()[0])


# --- training states --------------------------------------------------------------------------------------------------


class _Grid:
    def __init__(self, ns):
        self.value, self.bits, self.seen, self.always = (
            ns.Float([0.0] * 8),
            ns.UInt8([1] * 8),
            ns.Bool([True] * 8),
            ns.Bool([False] * 8),
        )
        self.turn, self.resolution, self.unsampled = 3, 2, ns.UInt32([1, 6])

    def restore(self, value, bits, seen, always, turn: int, unsampled=None) -> None:
        assert len(value) == len(bits) == len(seen) == len(always) == 8 and isinstance(turn, int)
        assert unsampled is None or unsampled.ndim == 1


def _trainer(kind):
    """A trainer of ``kind`` with only the members of its state."""
    import mitsuba as mi

    from nerg_mi.train.trainer import StepClock

    ns = _parts()[0]
    optimiser = mi.ad.Adam(lr=0.1)
    optimiser["grid.table"] = ns.Float([1.0] * 6)
    optimiser["net.0"] = ns.TensorXf(np.ones((2, 3), np.float32))
    averaged = {k: type(v)(v) for k, v in optimiser.items()}
    trainer = kind.__new__(kind)
    vars(trainer).update(
        optimiser=optimiser,
        averaged=averaged,
        grid=_Grid(ns),
        hard_pixels=np.zeros(4, np.float32),
        rng=np.random.default_rng(1),
        steps=7,
        rays=100,
        samples=1000,
        _started=0.0,
        reserved_seconds=0.0,
        _reserved_at=(0.0, 0.0),
        stride=4,
        prepass_samples_per_ray=10.0,
        best=None,
        extraction=SimpleNamespace(
            pieces_done=0,
            dense_cells=ns.UInt8([0] * 8),
            contributing_cells=ns.UInt8([0] * 8),
            dilated_dense=None,
            restore=lambda *state: None,
        ),
        clock=StepClock(),
    )
    return trainer


def _make_radiance_run(folder: Path) -> None:
    from nerg_mi.train.radiance_run import save_run
    from nerg_mi.train.radiance_trainer import RadianceTrainer

    trainer, row = _trainer(RadianceTrainer), {"steps": 3, "seconds": 1.0, "psnr": 20.0, "every_pixel": 1}
    trainer.keep_if_best(row)
    save_run(trainer, folder / "field.run", _METADATA, [row])


def _read_radiance_run(folder: Path) -> object:
    from nerg_mi.train.radiance_run import load_run
    from nerg_mi.train.radiance_trainer import RadianceTrainer

    return load_run(_trainer(RadianceTrainer), folder / "field.run", _METADATA)


def _make_gaze_run(folder: Path) -> None:
    from nerg_mi.train.gaze_product import ProductTrainer
    from nerg_mi.train.gaze_run import GazeFit, GazeRunFile

    trainer, fit = _trainer(ProductTrainer), GazeFit(best_step=2, schedule=5)
    GazeRunFile(folder / "gaze.run", _METADATA).save("fit", trainer, fit.to_dict(), trainer.averaged, force=True)


def _read_gaze_run(folder: Path) -> object:
    from nerg_mi.train.gaze_product import ProductTrainer
    from nerg_mi.train.gaze_run import GazeRunFile

    file = GazeRunFile(folder / "gaze.run", _METADATA, resume=True)
    return file.restore("fit", _trainer(ProductTrainer))


# --- torch ------------------------------------------------------------------------------------------------------------


def _table(levels: int) -> dict:
    rng = np.random.default_rng(0)
    return {
        "encoder.embeddings": rng.random((8 * levels, 2)).astype(np.float32),
        "encoder.offsets": np.arange(0, 8 * levels + 1, 8, dtype=np.int32),
    }


def _weights(*shapes) -> list[np.ndarray]:
    return [np.random.default_rng(k).random(s).astype(np.float32) for k, s in enumerate(shapes)]


def _radiance_state() -> dict:
    names = ("sigma_net.0.weight", "sigma_net.1.weight", "color_net.0.weight", "color_net.1.weight")
    cube = np.float32([-1, -1, -1, 1, 1, 1])
    return {
        "aabb_train": cube,
        "aabb_infer": cube,
        **_table(2),
        **dict(zip(names, _weights((4, 4), (3, 4), (4, 6), (3, 4)))),
    }


def _make_ngp(folder: Path) -> None:
    from nerg_mi.formats.torch_files import write_torch

    state = _radiance_state()
    shadow = [v for k, v in state.items() if k.endswith((".embeddings", ".weight"))]
    write_torch(
        folder / "ngp.pth",
        {
            "epoch": 7,
            "global_step": 99,
            "stats": {"loss": [0.5]},
            "mean_density": 0.1,
            "model": state,
            "ema": {"decay": 0.95, "shadow_params": shadow},
        },
    )


def _read_ngp(folder: Path) -> object:
    from nerg_mi.formats.torch_ngp import ImportOptions, read_torch_ngp

    return read_torch_ngp(folder / "ngp.pth", _parts()[0], options=ImportOptions(finest=32))


def _make_nerg(folder: Path) -> None:
    from nerg_mi.formats.torch_files import write_torch

    names = (
        "net1.0.weight",
        "net1.3.weight",
        "net2.0.weight",
        "net2.3.weight",
        "emit_head.weight",
        "capture_head.weight",
    )
    nets = dict(zip(names, _weights((4, 4), (3, 4), (4, 7), (4, 4), (1, 4), (1, 4))))
    nerf = {f"model_nerf.{k}": v for k, v in _radiance_state().items()}
    write_torch(
        folder / "nerg.pth",
        {
            "epoch": 2,
            "variant": "EmitCapture",
            "model": {"aabb_train": np.float32([-1, -1, -1, 1, 1, 1]), **_table(2), **nets, **nerf},
        },
    )


def _read_nerg(folder: Path) -> object:
    from nerg_mi.formats.torch_ngp import ImportOptions, read_nerg

    return read_nerg(folder / "nerg.pth", _parts()[0], options=ImportOptions(finest=32))


CHECKPOINTS = [
    Reader("radiance checkpoint", _make_radiance, {"field.safetensors": ("safetensors",)}, _read_radiance),
    Reader("gaze checkpoint", _make_gaze("product"), {"gaze.safetensors": ("safetensors",)}, _read_gaze),
    Reader("log gaze checkpoint", _make_gaze("log"), {"gaze.safetensors": ("safetensors",)}, _read_gaze),
    Reader("gaze ensemble", _make_gaze("ensemble"), {"gaze.safetensors": ("safetensors",)}, _read_gaze),
    Reader("radiance run", _make_radiance_run, {"field.run": ("safetensors",)}, _read_radiance_run),
    Reader("gaze run", _make_gaze_run, {"gaze.run": ("safetensors",)}, _read_gaze_run),
    Reader("torch-ngp checkpoint", _make_ngp, {"ngp.pth": ("zip",)}, _read_ngp, needs="torch"),
    Reader("NeRG checkpoint", _make_nerg, {"nerg.pth": ("zip",)}, _read_nerg, needs="torch"),
]
