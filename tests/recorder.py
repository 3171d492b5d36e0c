"""A reporter that records its messages."""

from __future__ import annotations

from nerg_mi.errors import clean_text


class Recorder:
    def __init__(self):
        self.messages: list[str] = []
        self.warnings: list[str] = []
        self.steps: list[tuple[float, str]] = []

    def message(self, text: str) -> None:
        self.messages.append(clean_text(text))

    def warn(self, text: str) -> None:
        self.warnings.append(clean_text(text))

    def progress(self, share: float, text: str = "") -> None:
        self.steps.append((share, clean_text(text)))

    def share_at(self, text: str) -> float:
        """Return the last progress fraction reported with ``text``."""
        return {t: share for share, t in self.steps}[text]
