"""Ready scenes, each a folder with its scene file and the script that makes it."""
