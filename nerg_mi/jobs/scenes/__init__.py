"""What a scene file is made of when it is written for checkpoints: its files, its place, its observer, its camera."""
