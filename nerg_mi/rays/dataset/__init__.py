"""Rays that outgrow one file: a folder of Parquet parts by place, day and people, with an account of each source."""
