"""The errors that a user is expected to meet, told in one sentence."""

from __future__ import annotations

import re


class NergError(ValueError):
    """Something the user can put right. The message is one sentence: the thing that is wrong, and the remedy.

    The command `nerg` prints it without a traceback and ends with exit code 1.
    """


class MissingFile(NergError, FileNotFoundError):
    """A file that is not there; the message names it."""


class UnusableLLVM(ImportError):
    """The libLLVM that Dr.Jit would load cannot run its kernels. The message names the version and the remedy."""


def sentence(error: BaseException) -> str:
    """What `error` says, on one line.

    Mitsuba embeds the whole Python traceback of a plugin's constructor in its message. Kept are where in the scene it
    happened (before the traceback) and what was said there (its last line).
    """
    text = str(error).strip()
    if isinstance(error, FileNotFoundError) and error.filename is not None:
        text = f'there is no file "{error.filename}".'
    before, marker, trace = text.partition("Traceback (most recent call last):")
    if marker:
        # The exception's line starts at the left margin and may run on over several lines; frames are indented.
        said = re.split(r"\n(?=[A-Za-z_][\w.]*:\s)", trace)[-1]
        text = before.rstrip() + " " + re.sub(r"^[A-Za-z_][\w.]*:\s+", "", said.strip())
    text = re.sub(r"^\[[\w.]+\.(cpp|h):\d+\]\s*", "", text)
    return " ".join(text.split()) or type(error).__name__
