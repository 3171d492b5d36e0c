"""Recordings of headsets, trackers and skeletons, read as rays of attention."""
