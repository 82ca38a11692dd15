"""The paper as printed: Yang, Ge, Wang, "MSGS-SLAM: Monocular Semantic Gaussian Splatting SLAM", Symmetry 2025, 17(9).

A room to hold beside the paper, reached by `reconstruct --method paper`. Every numbered equation has a function whose
docstring begins with its number, or with those of several: (1) to (3) in `uncertainty`, (4) to (9) in `rendering`, (10)
to (16) in `tracking`, (17) to (20) in `mapping`, (21) to (26) in `adjustment`. The paper's figure 1 is `slam`, and
`stages` puts it into a run.
"""
