"""The public Python API behind `import nerg_mi as nerg`: scenes, images, queries and training.

`nerg_mi.__all__` lists the public names; each is imported on first use.
"""
