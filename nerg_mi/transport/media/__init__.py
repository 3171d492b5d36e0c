"""What is marched: a trained field or Mitsuba volumes, with their cells, and what their samples contribute."""
