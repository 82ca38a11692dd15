"""Structure from motion of the keyframes.

In go images and what is known of the camera; out come a calibrated camera with its stated deviation, a backbone of
poses and points, and the verified matches of all pairs. Begin at `driver`: features and flow are matched, `candidates`
builds models of them by COLMAP's mappers, `consistency` and `components` judge them by what they leave unexplained.
"""
