"""Parallel and resumable jobs: `task` defines the parts and their keys, `store` keeps their outputs, `execution` runs
one, and `engines` run all of them in this process, in processes of this machine, or on a Dask `cluster`.

A job creates a `task.Plan` and receives the outputs of its parts in order from `engines.run_plan`. Outputs that are
already in the store are reused. The choice of the engine does not affect the results.
"""
