"""Rays that a scene shows: those of a file, or some of a dataset, which are kept in a file beside the scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nerg_mi.files.atomic import check_writable
from nerg_mi.jobs.reporter import Reporter
from nerg_mi.rays.dataset import Conditions, RayDataset, is_dataset
from nerg_mi.rays.dataset_open import load_rays
from nerg_mi.rays.rays import Rays

MOST = 1_000_000
"""Rays of a dataset that a scene shows, at most."""


@dataclass(frozen=True, eq=False)
class SceneRays:
    """``rays`` and the ``file`` of them that the scene names, None where there are none; ``made``: files that were
    written; ``dataset``: what the rays are of, if they are some of a dataset."""

    rays: Rays | None
    file: Path | None
    made: tuple[Path, ...] = ()
    dataset: Path | None = None

    def of_person(self, person: str) -> Rays | None:
        """The rays to look a ``person`` up in: of a dataset all of theirs, since a sample lacks most moments."""
        if self.dataset is None:
            return self.rays
        return RayDataset.open(self.dataset).load(Conditions(persons=[person]))


def check_rays(given: Path | None, scene: Path) -> None:
    """Raise `NergError` where rays of a dataset cannot be written beside the ``scene``."""
    if given is not None and is_dataset(given):
        check_writable(_file_beside(scene))


def load_scene_rays(given: Path | None, scene: Path, reporter: Reporter) -> SceneRays:
    """The rays of the file or dataset ``given``; of a dataset `MOST` at most, each as likely as any other, are written
    beside the ``scene``, which reads files alone."""
    if given is None or not is_dataset(given):
        return SceneRays(None if given is None else Rays.load(given), given)
    path, rays = _file_beside(scene), load_rays(given, most=MOST)
    rays.save(path)
    reporter.message(f'the scene shows {len(rays):,} rays of "{given}", kept beside it')
    return SceneRays(rays, path, (path,), given)


def _file_beside(scene: Path) -> Path:
    return scene.with_suffix(".rays.npz")
