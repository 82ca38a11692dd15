"""Where images come from: videos, folders, panoramas, data sets."""
