"""Options made of a dataclass: names, defaults, flags, help, and what is handed on."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, get_type_hints

import pytest
import typer
from typer.testing import CliRunner

from nerg_mi.cli.options import takes
from nerg_mi.jobs.options import option, parse_numbers


@dataclass(frozen=True, kw_only=True)
class Brew:
    """Of a job that makes tea."""

    leaves: str = option("green", "Which leaves.")
    kettle_file: Path | None = option(None, "Where the kettle is.")
    sugar: bool = option(False, "With sugar.")
    stir: bool = option(True, "Stirred.")
    minutes: float = option(3.0, "How long.", "-t", "--time", min=0.5)
    guests: tuple[str, ...] = option((), "Who drinks it; may be given several times.")
    origin: tuple[float, ...] | None = option(None, "Where it grew.", "--from", parse=parse_numbers)
    secret: int = option(7, "Nobody's business.")


@pytest.fixture
def serve():
    """Runs a command with the options of `Brew`, and gives what it was handed; and the app."""
    handed, app = [], typer.Typer(rich_markup_mode=None)

    @app.command()
    @takes(Brew, "secret")
    def tea(
        cup: Annotated[str, typer.Argument(help="What it is poured into.")],
        brew: Brew,
        table: Annotated[int, typer.Option(help="Where it is served.")] = 1,
    ) -> None:
        """Make tea."""
        handed.append((cup, brew, table))

    def run(*line):
        done = CliRunner().invoke(app, list(line))
        return done, handed[-1] if handed else None

    return run


def test_defaults_are_those_of_the_dataclass(serve):
    assert serve("mug")[1] == ("mug", Brew(), 1)


def test_every_option_arrives(serve):
    line = "mug --leaves black --kettle-file k.txt --sugar --no-stir -t 4.5 --guests a --guests b --table 2"
    expected = Brew(
        leaves="black", kettle_file=Path("k.txt"), sugar=True, stir=False, minutes=4.5, guests=("a", "b"), secret=7
    )
    assert serve(*line.split())[1] == ("mug", expected, 2)


@pytest.mark.parametrize("wrong", [("--secret", "1"), ("--no-sugar",), ("--minutes", "4"), ("--time", "0.1")])
def test_what_is_no_option_is_refused(serve, wrong):
    done, handed = serve("mug", *wrong)
    assert done.exit_code == 2 and handed is None


def test_help_tells_what_each_field_means(serve):
    shown = " ".join(serve("--help")[0].stdout.split())
    assert "Make tea." in shown and "Where it is served." in shown
    for f in fields(Brew):
        assert (f.metadata["help"] in shown) == (f.name != "secret")


def test_a_command_shows_its_options_to_whoever_asks_for_its_types():
    @takes(Brew)
    def tea(brew: Brew) -> None:
        pass

    assert set(get_type_hints(tea)) == {f.name for f in fields(Brew)}


def test_a_word_that_is_parsed_is_called_as_it_was_given(serve):
    assert serve("mug", "--from", "1,2.5")[1][1].origin == (1.0, 2.5)
    done, _ = serve("mug", "--from", "east")
    assert "--from is numbers" in str(done.exception)
