"""Report on a gaze field as one self-contained HTML file."""
