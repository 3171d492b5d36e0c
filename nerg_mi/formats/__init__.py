"""Files in and out. torch is imported in one file only."""
