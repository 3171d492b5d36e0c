"""File formats of fields, meshes, splats and areas of interest. Readers refuse unsupported files and never run code.

Files that nerg_mi writes carry a version. Every version that was ever written can be read.

- Radiance field (``.safetensors``): arrays of the networks and of the occupancy grid (one bit per cell and per
  octant of a cell), and a JSON object ``nerg`` in the header: kind, architecture, box, colour space, units,
  provenance.
- Gaze field (``.safetensors``): the same for one field or an ensemble, with the cells of ``support``, the held-out
  participants and zones, and the re-aimed hits, if they have a weight: ``hits.origins`` and ``hits.points`` (n, 3)
  in the field's frame, and ``weight``, ``bandwidth`` and ``kappa`` in the header.
- Training state (``.run``), while a training runs: weights, optimiser moments, random streams, history.
- Alignment (``.json``): ``matrix``, the 4x4 similarity from recordings to environment, ``scale``, ``evidence``,
  ``residuals``, ``uncertainty`` (standard deviations ``cm``, ``degrees``, ``scale_percent``; without hit points an
  interval: ``level``, ``turn_degrees``, ``scale``, ``shift_cm``), ``files`` with SHA-256, ``forced``. ``--align``
  also takes a JSON list of the four rows.
- Attention statistics (a folder): tables as ``.csv``, ``.md`` and, with the extra ``parquet``, ``.parquet`` (CSV
  cells that are formulas begin with an apostrophe), ``aois.png``, ``transitions.png``, ``about.json`` with inputs,
  checksums, options and versions, and ``suppressed.txt`` if values were blanked.
- ``aoi.csv`` of ``nerg demo``: one row per object; ``observer_share`` (0 to 1) is its share of the observer's gaze.
- ``run.json`` of ``nerg demo`` and of evaluations: inputs with checksums, seed, versions, options.
- Images: ``.exr`` has every channel in float32 (``R``, ``G``, ``B``, and AOVs such as ``depth.Y`` and ``gaze.Y``);
  ``.png`` has colour in sRGB with 8 bits, or an overlay with its scale. Both state how they were made.

Arrays are little-endian float32, or float16 with ``half``. Positions are in metres in a right-handed frame with z
up, times in seconds, gaze densities in 1/sr. Images have rows from the top.
"""
