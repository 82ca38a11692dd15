"""Completes a keyframe's depth where its views do not agree. `candidates` are what geometry offers each pixel,
`evidence` is what other keyframes say of them, and `network`, learned on made rooms, weighs them and says how far off
the result may be."""
