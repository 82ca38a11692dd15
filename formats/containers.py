"""The containers in which a video is looked for, and FFmpeg's options that say so."""

from __future__ import annotations

# The containers of one video each. Left out is what names other files (playlists, scripts, numbered images) or is made
# into images by FFmpeg (text): such a file would show files from elsewhere on this disk, whatever it is called.
_CONTAINERS = (
    "mov,mp4,m4a,3gp,3g2,mj2", "matroska,webm", "avi", "mpegts", "mpeg", "mpegvideo", "m4v", "flv", "live_flv", "asf",
    "asf_o", "ogg", "gif", "apng", "h264", "hevc", "av1", "obu", "ivf", "vvc", "vc1", "dv", "mxf", "nut", "wtv", "rm",
    "h263", "mjpeg", "mjpeg_2000", "yuv4mpegpipe", "gxf", "swf", "nsv", "dirac", "cavsvideo", "avs2", "avs3", "r3d",
)  # fmt: skip
OPEN_OPTIONS = {"format_whitelist": ",".join(_CONTAINERS), "protocol_whitelist": "file"}


def as_opencv_writes_them() -> str:
    """OPEN_OPTIONS as the variable OPENCV_FFMPEG_CAPTURE_OPTIONS has them."""
    return "|".join(f"{name};{value}" for name, value in OPEN_OPTIONS.items())
