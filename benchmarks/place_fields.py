"""Fields that a benchmark of places has trained in its folds, and what they are scored on."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path


class FoldField:
    """The field of a fold, ``loaded``, in its ``place``, with all ``rays``; ``seed`` of the fold."""

    def __init__(self, path: Path, rays: Path, where: dict, seed: int, ns):
        from nerg_mi.formats.fields import load_gaze
        from nerg_mi.jobs.gaze_places import place_of_training
        from nerg_mi.jobs.options.evaluation import GazeEvaluationOptions
        from nerg_mi.rays.rays import Rays

        self.loaded, metadata = load_gaze(path, ns)
        about = metadata["provenance"]
        self.rays, self.seed, self.account = Rays.load(rays), seed, about["test"]
        self.scoring = GazeEvaluationOptions(**{k: v for k, v in where.items() if k in ("field", "scene")}, seed=seed)
        self.place = place_of_training(path, about, self.loaded.box, self.scoring, ns)

    def test(self, split: str):
        """``(rays that it was trained on, `GazeTest`)`` of a split of `evaluation.SPLITS`."""
        from nerg_mi.evaluation.gaze import evaluation

        of = self.scoring
        train, scored, centres = evaluation.held_out_rays(self.rays, self.account, split, self.seed)
        test = evaluation.make_test(
            scored, centres, self.account["radius"], of.kappa, of.directions, of.min_rays, seed=self.seed
        )
        return train, test

    def density(self):
        """Its densities as it is now, as a function of positions and directions."""
        from nerg_mi.evaluation.gaze.scores import gaze_field

        return gaze_field(self.loaded, self.place.medium, self.place.align)


def fold_fields(folder: Path, rays: Path, where: dict, args: argparse.Namespace, ns, **options) -> Iterator[FoldField]:
    """The field of each fold of a place that `place_rays.write_place` wrote, with these ``options`` of a fold besides:
    kept ones of `places.py` with the same options, where they are in the same folder."""
    from nerg_mi.cli.progress import TerminalReporter
    from nerg_mi.jobs.folds import evaluate_folds
    from nerg_mi.jobs.options.folds import FoldOptions

    asked = FoldOptions(**where, folds=args.folds, splits="both", threads=args.threads, **options)
    with TerminalReporter() as reporter:
        found = evaluate_folds(rays, folder / "eval", asked, reporter)
    for seed, path in enumerate(found.fields):
        yield FoldField(path, rays, where, seed, ns)
