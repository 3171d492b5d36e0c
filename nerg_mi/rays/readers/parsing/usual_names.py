"""Names that columns of headsets' logs usually have, in lower case with underscores; the earlier ones are preferred."""

from __future__ import annotations

TIMES = ("t", "time", "timestamp", "time_s", "unity_time", "utc_timestamp", "raw_timestamp", "sender_time")
PERSONS = (
    "person",
    "participant",
    "participant_id",
    "participantid",
    "user",
    "user_id",
    "userid",
    "subject",
    "subject_id",
    "id",
)
HITS = ("hit", "gaze_hit", "hit_point", "hit_pos", "hit_position")
DIRECTIONS = ("gaze_dir", "gaze_direction", "gaze_forward")
EYES = ("gaze_origin", "gaze_position", "eye_position")
HEADS = ("head_pos", "head_position", "hmd_pos")
ROTATIONS = ("head_rot", "head_rotation", "hmd_rot")

# Names that do not say of what: where there are none of those above.
BARE_DIRECTIONS = ("dir", "direction", "d")
BARE_PLACES = ("origin", "pos", "position", "")
BARE_ROTATIONS = ("rot", "rotation", "quaternion", "quat", "q")

MORE_HEADS = (*HEADS, "hmd_position", "camera_pos", "camera_position", "cam_pos", "cam_position")
"""Of heads in logs of one headset, where a camera is the head's."""
MORE_ROTATIONS = (*ROTATIONS, "hmd_rotation", "camera_rot", "camera_rotation", "cam_rot", "cam_rotation")
