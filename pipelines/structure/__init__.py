"""Structure from motion of the keyframes: a calibrated camera and a backbone of poses and points."""
