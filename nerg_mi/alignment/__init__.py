"""From one coordinate system to another: the similarity that leads from tracking, or a twin, into a place."""
