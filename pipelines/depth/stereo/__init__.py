"""Dense depth from several posed views: plane sweep, semi-global smoothing, refinement, cross-view consistency."""
