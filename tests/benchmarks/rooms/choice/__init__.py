"""Completing a keyframe's depth by a learned choice among geometric candidates: measured here, not in the product."""
