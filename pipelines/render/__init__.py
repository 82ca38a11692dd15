"""The differentiable renderer of isotropic semantic Gaussians, and the map that it draws (`gaussian_map`).

Begin with `api`: `render` draws a map from a camera, `composite` blends already projected Gaussians, and gradients flow
through both; `inspection` looks at a map without gradients. `reference` is the readable backend, in plain torch, that
judges the compiled ones of the CPU (`cpu*`) and of NVIDIA cards (`cuda*`).
"""
