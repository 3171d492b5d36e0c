"""Ready-made scenes, each a folder with the script that generates it."""
