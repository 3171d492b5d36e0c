"""The observer: where they stand, what they see, and the gaze field as it is for them."""
