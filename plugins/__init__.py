"""The Mitsuba face: one plugin a file; the class docstring is its manual page."""
