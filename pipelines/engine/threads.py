"""How many CPU threads the libraries that compute use."""

from __future__ import annotations


def set_threads(threads: int) -> None:
    """How many CPU threads this process uses."""
    import cv2
    import torch

    from msgs_slam.pipelines.gaussians.render import set_threads

    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    set_threads(threads)
