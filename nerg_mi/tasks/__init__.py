"""Long work in parts: `task` names them by all that they depend on, `store` keeps their outputs, and `engines` run them
here, in processes of this machine or on a Dask cluster.

A job makes a `task.Plan` and takes the outputs of its parts, in its order, from `engines.run_plan`; what the store
holds already is not made again. An engine decides where a part runs, and never what comes of it.
"""
