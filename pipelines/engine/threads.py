"""Number of CPU threads in the libraries that compute."""

from __future__ import annotations


def set_threads(threads: int) -> None:
    """Let the libraries of this process use so many CPU threads."""
    import cv2
    import scipy.linalg  # noqa: F401 (brings a BLAS of its own, which is there to be told)
    import torch
    from threadpoolctl import threadpool_limits

    from ..compute.threads import set_threads

    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    set_threads(threads)
    # Of numpy's and scipy's BLAS: on more its sums are others, and on the small matrices here they wait for each other
    # longer than they work, on a busy machine twenty times as long. Threads of ours call it side by side.
    threadpool_limits(1, "blas")
