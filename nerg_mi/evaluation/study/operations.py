"""How much work a render is, counted: operations traced into its kernels, and evaluations made."""

from __future__ import annotations

import drjit as dr


def traced_operations(render) -> int:
    """Operations of all kernels that the call ``render()`` launches.

    Dr.Jit counts the instructions of its intermediate representation, loops counted once: what is not traced
    is not counted, and a count does not depend on the machine or on how busy it is.
    """
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history()
        dr.eval(render())
        dr.sync_thread()
        return sum(kernel.get("operation_count", 0) for kernel in dr.kernel_history())
