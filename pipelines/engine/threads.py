"""Number of CPU threads in the libraries that compute."""

from __future__ import annotations


def set_threads(threads: int) -> None:
    """Let the libraries of this process use so many CPU threads."""
    import cv2
    import torch

    from msgs_slam.pipelines.gaussians.render import set_threads

    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    set_threads(threads)
