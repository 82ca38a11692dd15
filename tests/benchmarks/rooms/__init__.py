"""Made rooms by seed: furnished, lit and filmed by a program, with exact depth, poses and classes."""
