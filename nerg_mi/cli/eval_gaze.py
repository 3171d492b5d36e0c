"""``nerg eval gaze``: a gaze field at positions and of people that it was not trained on, beside what needs no
field."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.errors import NergError


def eval_gaze(
    gaze: Annotated[
        Path, typer.Argument(help="Checkpoint of a gaze field that was trained with --test-zones (.safetensors).")
    ],
    rays: Annotated[Path, typer.Argument(help="The rays file that it was trained on.")],
    field: Annotated[
        Path | None, typer.Option(help="Radiance field that it was trained in. Default: its name, beside it.")
    ] = None,
    scene: Annotated[Path | None, typer.Option(help="Or: the Mitsuba scene.")] = None,
    geometry: Annotated[Path | None, typer.Option(help="Or: the place of hit points (.vol).")] = None,
    split: Annotated[
        str | None,
        typer.Option(
            help="both: new positions and people; pos: new positions; people: new people. Default: both, or pos."
        ),
    ] = None,
    kappa: Annotated[float, typer.Option(help="Concentration of the kernel of truth and baselines.")] = 20.0,
    blind_kappa: Annotated[float, typer.Option(help="That of the blind density which bits are counted from.")] = 50.0,
    directions: Annotated[int, typer.Option(help="Directions that maps are compared in.")] = 2048,
    min_rays: Annotated[int, typer.Option(help="Rays at a test position at least.")] = 64,
    resamples: Annotated[int, typer.Option(help="Of the people, for the intervals.")] = 200,
    pictures: Annotated[int, typer.Option(help="Test positions to draw.")] = 4,
    seed: Annotated[int, typer.Option(help="Seed of rays, resamples and halves.")] = 0,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for tables and pictures. Default: GAZE.eval")
    ] = None,
    threads: Annotated[int | None, typer.Option(help="CPU threads. Default: all.")] = None,
    mode: Annotated[str, typer.Option("-m", "--mode", help="Mitsuba variant.")] = "llvm_ad_rgb",
) -> None:
    """Scores beside uniform, position-blind, nearest probes, nearest rays and the other half of the people."""
    import drjit as dr

    from nerg_mi.evaluation.gaze import evaluation
    from nerg_mi.evaluation.gaze.baselines import standard_baselines
    from nerg_mi.evaluation.gaze.report import side_by_side, write_report
    from nerg_mi.evaluation.gaze.scores import EPS, gaze_field
    from nerg_mi.field.backend import namespace
    from nerg_mi.files.atomic import check_folder
    from nerg_mi.files.checksum import file_sha256
    from nerg_mi.formats.fields import load_gaze
    from nerg_mi.maths.similarity import Similarity
    from nerg_mi.rays.rays import Rays
    from nerg_mi.rendering.pictures import activate

    output = output or gaze.with_suffix(".eval")
    check_folder(output)
    activate(mode)
    if threads is not None:
        dr.set_thread_count(threads)
    ns = namespace(mode)
    trained, meta = load_gaze(gaze, ns)
    about = meta["provenance"]
    if "test" not in about:
        raise NergError(
            f'"{gaze}" was trained on all positions, so that none is left to score; train it with --test-zones 3'
        )
    if about.get("rays_file", {}).get("sha256") not in (None, file_sha256(rays)):
        raise NergError(f'"{gaze}" was trained on other rays than "{rays}"; give the file {about["rays_file"]["file"]}')
    account, data = about["test"], Rays.load(rays)
    split = split or ("both" if account.get("people") else "pos")
    train, scored, centres = evaluation.held_out_rays(data, account, split, seed)
    test = evaluation.make_test(scored, centres, account["radius"], kappa, directions, min_rays, seed=seed)
    align = None if about.get("align") is None else Similarity(about["align"])
    medium = _place(gaze, about, field, scene, geometry, ns)
    blind, others = standard_baselines(train, account["radius"], kappa, blind_kappa, seed)
    methods = {
        "gaze field": gaze_field(trained, medium, align, about.get("probes", {}).get("depth", "median")),
        **others,
    }
    rows = evaluation.evaluate_gaze(test, methods, blind, resamples, seed)
    half = evaluation.split_half(scored, test.centres, account["radius"], kappa, blind, min_rays, seed)
    rows += [half] if half else []
    persons = evaluation.person_rows(
        test, {k: methods[k] for k in ("gaze field", "4,096 nearest rays")}, blind, min_rays
    )
    notes = (
        f"# {gaze.name}: {split}\n\n{len(test.centres)} positions, {len(test.persons)} persons; {len(train):,} of {len(data):,} rays "
        f"trained on. Truth: rays within {account['radius']:g} m, kappa {kappa:g}, {directions} directions of equal area; KLD in nats with "
        f"{EPS:g} of the uniform density added; MAE in 1/sr; AUC against all directions, sAUC against rays of other positions; bits a ray "
        f"beyond the position-blind density of kappa {blind_kappa:g}; loglik in nats of 1/sr. Brackets: 1.96 standard errors either way, from {resamples} resamples of the persons. "
        "Split half: half of the people predict the other half, where both have enough rays; a reference, no bound."
    )
    files = write_report(
        output,
        rows,
        persons,
        {"gaze": gaze.name, "split": split, "kappa": kappa, "positions": len(test.centres)},
        notes,
    )
    if pictures:
        shown = ("gaze field", "position-blind", "16 nearest probes", "4,096 nearest rays")
        files.append(output / "positions.png")
        side_by_side(test, {k: methods[k] for k in shown}, files[-1], pictures)
    _print(rows, f"{gaze.name}, {split}: {len(test.centres)} positions, {len(test.persons)} persons")
    typer.echo("\n".join(f"wrote {path}" for path in files))


def _print(rows: list[dict], title: str) -> None:
    from nerg_mi.evaluation.gaze.evaluation import SCORES
    from nerg_mi.evaluation.gaze.scores import print_scores

    print_scores([{k: r[k] for k in ("method", *SCORES, "integral")} for r in rows], title)


def _place(gaze: Path, about: dict, field, scene, geometry, ns):
    """What the field was trained in: the file that is named, or the one of the checkpoint's beside it."""
    from nerg_mi.files.checksum import file_sha256
    from nerg_mi.training.geometry import places

    if about.get("geometry") == "none":
        return None
    makers = {
        "field_file": (field, "--field", lambda p: places.place_of_field(p, ns)),
        "scene_file": (scene, "--scene", places.place_of_scene),
        "geometry_file": (geometry, "--geometry", places.place_of_volume),
    }
    key = next((k for k in makers if k in about), None)
    if key is None:
        raise NergError(f'"{gaze}" does not say what it was trained in')
    given, option, make = makers[key]
    path = given or gaze.parent / about[key]["file"]
    if not path.is_file():
        raise NergError(f'"{path}", which the field was trained in, does not exist; say where it is with {option}')
    if file_sha256(path) != about[key]["sha256"]:
        raise NergError(f'"{path}" is not the file that "{gaze}" was trained in; give that one with {option}')
    return make(path).medium
