"""Compiled loops, and what they run on.

Kernels of numba (`jit`), vectors in them (`lanes`), a pool of threads (`threads`) and kernels of Triton on a card
(`gpu`). Adam's step (`adam`) and the structural similarity (`ssim`) are ready ones. Arrays and tensors go in and come
out; nothing here knows of maps, images or a run.
"""
