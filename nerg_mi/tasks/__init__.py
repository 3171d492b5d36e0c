"""Long work in parts: content-addressed tasks, a store of their outputs, and whoever runs them, here or on a cluster.

A job makes a `plan.Plan` of `task.Task`s and takes their outputs in the plan's order from `run.run_plan`; what a
`store.Store` holds already is not made again. A `protocol.Scheduler` only says where a task is run, and never what
comes of it.
"""
