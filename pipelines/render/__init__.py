"""The differentiable renderer of isotropic semantic Gaussians, and the map that it draws (`gaussian_map`).

Begin with `api`: `render` draws a map from a camera, `composite` blends already projected Gaussians, and gradients flow
through both; below, functions look at a map without gradients. `rules` says what the backends of the CPU (`cpu*`) and
of NVIDIA cards (`cuda*`) agree on; a readable one in `tests/pipelines/render/reference.py` judges both.
"""
