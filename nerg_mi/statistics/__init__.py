"""Numbers of attention on things: looks, dwell, reach, intervals clustered by person; NumPy alone."""
