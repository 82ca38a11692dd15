"""Stage 4: the map of Gaussians, optimised until it shows what the keyframes show.

In go poses, images and the proxy's maps, out comes `map.safetensors`, by submaps where a recording is long. Begin with
`run` in `stage.py`, then `optimise.py`: `Schedule` says which view comes when, `losses.py` what is wrong in it,
`growth.py` splits and prunes.
"""
