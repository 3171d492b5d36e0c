"""What a session tells of what it finds."""

from __future__ import annotations

from typing import Protocol


class Listener(Protocol):
    """Whoever shows what a session finds."""

    def on_proxy(self) -> None:
        """There are points, or more of them."""
        ...

    def on_baked(self) -> None:
        """The points have the gaze of the observer."""
        ...

    def on_shares(self) -> None:
        """The shares of attention are those of the observer."""
        ...

    def on_range(self) -> None:
        """The automatic range of the layer that is shown is another one."""
        ...

    def on_error(self, error: BaseException) -> None:
        """A task has failed."""
        ...
