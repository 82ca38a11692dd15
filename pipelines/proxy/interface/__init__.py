"""Interface of providers of depth and labels: the frames with their cameras in, estimates out."""
