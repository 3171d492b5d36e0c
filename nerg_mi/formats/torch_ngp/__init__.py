"""Checkpoints of torch-ngp and of the NeRG paper's authors, read and written by torch (extra ``torch``)."""
