"""What `import nerg_mi as nerg` offers: scenes, pictures, queries and trainings, as a notebook wants them.

The names are those of `nerg_mi.__all__`; each is imported when it is first used.
"""
