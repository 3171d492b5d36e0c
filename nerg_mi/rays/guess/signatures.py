"""Presets by what tells their files from others: names of files, and of columns."""

from __future__ import annotations

from pathlib import Path

from nerg_mi.errors import NergError
from nerg_mi.files.line_blocks import line_blocks
from nerg_mi.rays.readers.parsing.column_finder import ColumnFinder

# By the name of a file, in a folder or given itself; what is beside it tells some apart.
_FILES = (
    ("neon", "gaze.csv", "info.json"),
    ("neon", "gaze.csv", "world_timestamps.csv"),
    ("tobii3", "gazedata.gz", "recording.g3"),
    ("glassestools", "gazeData.tsv", "calibration.xml"),
    ("pupil", "gaze_positions.csv", "head_pose_tracker_poses.csv"),
)
# By columns that all have to be there, the more telling first.
_COLUMNS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("vr_supermarket", ("ctw_00", "ctw_23", "ray_x", "eye_x", "opennessl", "opennessr", "xc")),
    ("arett", ("eyeDataTimestamp", "gazeHasValue", "isCalibrationValid", "gazeOrigin_x", "gazeDirection_x")),
    ("varjo", ("CaptureTime", "HMDPosition", "HMDRotation", "CombinedGazeForward", "GazeStatus")),
    ("eyenavgs", ("ViewIndex", "PositionX", "QuaternionX", "GazeQX")),
    ("aria", ("tracking_timestamp_us", "pitch_rads_cpf")),
    ("neon_mocap", ("timestamp [ns]", "gaze_origin_X", "gaze_origin_Y", "gaze_origin_Z", "gaze_dir_X")),
    ("neon", ("timestamp [ns]", "gaze x [px]", "gaze y [px]")),
    ("glassestools", ("timestamp", "frame_idx", "gaze_pos_vid_x", "gaze_pos_vid_y")),
    ("pupil", ("gaze_timestamp", "gaze_normal0_x", "eye_center0_3d_x")),
)
_HEADS = tuple(f"{a}_{b}" for a in ("head", "hmd", "camera", "cam") for b in ("pos", "position"))


def preset_of_files(path: Path) -> tuple[str, str] | None:
    """A preset by the names of files, and why; ``path``: a file or a folder."""
    for name, file, beside in _FILES:
        folder = path if path.is_dir() else path.parent
        if (path.is_dir() or path.name == file) and (folder / file).is_file() and (folder / beside).is_file():
            return name, f"{file} with {beside} beside it"
    if path.name.endswith("_head_hand_eye.csv"):
        return "hololens", "its name ends in _head_hand_eye.csv"
    if path.suffix.lower() == ".c3d":
        return "c3d", "its name ends in .c3d"
    return None


def preset_of_text(path: Path) -> tuple[str, str] | None:
    """A preset by the first line of a file, where that is no header, and why."""
    for block in line_blocks(path, "tracking file", 1):
        words = block[0].split("|")
        if len(words) == 3 and words[2].lstrip().startswith("["):
            return "skeleton", "its lines are id|time|[keypoints]"
        if block[0].startswith("GAZE_VECTOR_NAME\t"):
            return "qualisys", "its first line names a gaze vector"
        if block[0].lstrip("\ufeff").startswith("Format Version,"):
            return "motive", "its first line is that of Motive's export"
        break
    return None


def preset_of_columns(table: ColumnFinder) -> tuple[str, str] | None:
    """A preset by the columns of a table, and which of them tell."""
    there = set(table.columns)
    for name, needed in _COLUMNS:
        if set(needed) <= there:
            return name, f"it has the columns {', '.join(needed)}"
    return _of_words(table)


def _of_words(table: ColumnFinder) -> tuple[str, str] | None:
    """Presets that look for their columns, by names that are of one program alone."""
    find = lambda stems, axes="xyz": table.find_vector(*stems, axes=axes)
    sdk = ("gaze_origin_mm", "combined_gaze_origin_mm", "verbose_data_combined_eye_data_gaze_origin_mm")
    sdk += ("combined_eye_data_gaze_origin_mm", "left_gaze_origin_mm", "gaze_origin_l", "gaze_origin_c")
    sdk += ("verbose_data_left_gaze_origin_mm",)
    head = find(_HEADS)
    origin = find(sdk)
    if origin and head:
        return "sranipal", f"it has {origin[0]} beside {head[0]}"
    left = find([f"left_eye_{w}" for w in ("rotation", "rot", "gaze_rotation", "orientation")], "xyzw")
    if left:
        return "quest", f"it has a pose of each eye ({left[0]})"
    if find(("gaze_orientation", "gaze_pose_orientation"), "xyzw") and table.find("location_flags"):
        return "openxr", "it has gaze_orientation and location_flags"
    return None


def check_is_table(path: Path) -> None:
    """Raise `NergError` for what is neither a table nor a folder that is known."""
    if path.is_dir():
        names = ", ".join(f"{file} and {beside}" for _, file, beside in _FILES)
        raise NergError(f"the folder {path} is of no recording that is known by its files ({names}); name a file of it")
