"""Completes a keyframe's depth where its views do not agree. `evidence` has the depths that geometry offers each
pixel and what other keyframes say of them, and `network`, learned on made rooms and on real recordings, weighs them
and says how far off the result may be."""
