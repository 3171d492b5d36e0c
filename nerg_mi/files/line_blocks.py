"""Lines of large text files, plain or gzip, in blocks: memory stays bounded whatever the file holds."""

from __future__ import annotations

import codecs
import io
import os
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from typing import IO

from nerg_mi.errors import NergError

from .bounded import reading, size_of
from .inflating import open_gzip

LINE_CHARACTERS = 1 << 20
"""A line of a tracking file may be so long: HoloLens 2 writes 17,000 characters."""

_BLOCK_CHARACTERS = 1 << 24
_CHUNK = 1 << 22

OnBadLine = Callable[[int, str], None]
"""Told of a line that cannot be read: its number, from 1, and why. Readers that are given none raise `NergError`."""


def line_blocks(path: str | os.PathLike, what: str, most: int) -> Generator[list[str], None, None]:
    """Lines of the UTF-8 file ``path`` (inflated where its name ends in ``.gz``) with their ends, in blocks of at most
    ``most`` lines and some 16 million characters.

    ``what``: the kind of file, for messages. Raises `NergError` for a file that is damaged or no UTF-8 text, and for a
    line of more than `LINE_CHARACTERS`.
    """
    decoder, rest, found, count, characters = codecs.getincrementaldecoder("utf-8")(), "", [], 0, 0
    with _opened(path, what) as source:
        ended = False
        while not ended:
            with reading(path, what):
                data = source.read(_CHUNK)
            ended = not data
            try:
                text = rest + decoder.decode(data, final=ended)
            except UnicodeDecodeError as error:
                raise NergError(f'the {what} "{path}" is no UTF-8 text ({error.reason}); save it as UTF-8') from error
            # As files are split: at \n, \r or both, and not at the many other characters that end lines elsewhere.
            lines = io.StringIO(text, newline="").readlines()
            # The last line may go on, or end in the \r of a \r\n.
            rest = "" if ended or not lines else lines.pop()
            if max(map(len, [*lines, rest])) > LINE_CHARACTERS:
                at = next(k for k, line in enumerate([*lines, rest]) if len(line) > LINE_CHARACTERS)
                raise NergError(
                    f'line {count + len(found) + at + 1} of the {what} "{path}" has more than the {LINE_CHARACTERS:,} '
                    "characters that are read; is it a text file?"
                )
            found += lines
            characters += len(text) - len(rest)
            while len(found) >= most or (found and (ended or characters >= _BLOCK_CHARACTERS)):
                block, found = found[:most], found[most:]
                count += len(block)
                characters = sum(map(len, found))
                yield block


@contextmanager
def _opened(path: str | os.PathLike, what: str) -> Iterator[IO[bytes]]:
    if str(path).lower().endswith(".gz"):
        with open_gzip(path, what) as source:
            yield source
        return
    size_of(path, what)
    with reading(path, what):
        source = open(path, "rb")
    with source:
        yield source
