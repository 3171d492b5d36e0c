"""The option that gives values to the `<default>`s of a scene, the same for every command."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated

import typer

from nerg_mi.errors import NergError

Defines = Annotated[
    list[str] | None,
    typer.Option("-D", "--define", metavar="KEY=VALUE", help="Value for $KEY or a <default> of the scene; repeatable."),
]


def parse_defines(pairs: Iterable[str] | None) -> dict[str, str]:
    """`["spp=4", "name=a=b"]` as `{"spp": "4", "name": "a=b"}`. Raises NergError for a pair without a key or a "="."""
    values = {}
    for pair in pairs or ():
        key, equals, value = pair.partition("=")
        if not (key and equals):
            raise NergError(f'"-D {pair}" is no definition: write -D key=value')
        values[key] = value
    return values
