"""A keyframe's depth from its provider into the world: one scale field each, which makes views and points agree.

`tracking` writes the fields after its adjustment and `global_ba` after its own; whoever reads a keyframe's depth
through them has it in the unit of the world.
"""
