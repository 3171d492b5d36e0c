"""Posed image sets, cameras, structure from motion (package pycolmap, extra ``poses``) and saliency maps.

A set of posed photos is a folder, or the file in it that lists the poses. In this order, these are looked for:

1. ``transforms.json`` (nerfstudio, instant-ngp): ``camera_model`` or ``is_fisheye``, per file or frame. Held out:
   ``transforms_test.json`` or ``_val`` next to it, else ``test_filenames`` or ``val_filenames``, else every 8th
   frame.
2. ``transforms_train.json``, ``_val``, ``_test`` (Blender NeRF): ``camera_angle_x``. Held out: the test file, else
   the validation file.
3. ``sparse/0/`` (other numbers, ``sparse/``, ``colmap/sparse/0/``, or the folder itself) with ``images/``: COLMAP,
   binary or text. Held out: every 8th frame. Of several models the one with the most images is used.

Held-out frames are never used for training, even if a training file lists them too. File names may be written as on
another system: with backslashes, in another Unicode normalisation, in another case; if two files match, neither is
used. Images, masks and depth maps are read only below the folder of the set (for COLMAP, the folder that holds
``images/``), unless ``--allow-outside`` is set.

Frames that cannot be used are left out, one line each with the reason, and recorded in the provenance: images that
are missing, unreadable or of another shape than stated; poses that are not rigid; lenses that fold over within the
image; masks that are missing or cover everything; duplicates; frames that see nothing that another sees. Training
stops only if no frame is left.
"""
