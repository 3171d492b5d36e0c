"""Error against run time: scenes whose truth is known, at many settings."""
