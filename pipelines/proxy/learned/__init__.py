"""Depth and classes of keyframes by networks."""
