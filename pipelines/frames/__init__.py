"""Stage 1: from a source to frames, a calibrated camera and a backbone of keyframes."""
