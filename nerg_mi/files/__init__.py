"""Files in and out, whole or absent, within bounds; knows nothing of what they are for."""
