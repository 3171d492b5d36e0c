"""Ready scenes, each a folder with the script that makes it."""
