"""Sources of images: videos, folders, panoramas, data sets."""
