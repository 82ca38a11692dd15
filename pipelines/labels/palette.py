"""Display colours of classes, well apart from each other and the same for the same index."""

from __future__ import annotations

import colorsys


def class_colors(count: int) -> tuple[tuple[int, int, int], ...]:
    """`count` RGB colours; hue steps by the golden ratio, brightness alternates."""
    colors = []
    for i in range(count):
        value = (0.95, 0.7, 0.85)[i % 3]
        saturation = (0.55, 0.75, 0.4)[(i // 3) % 3]
        red, green, blue = colorsys.hsv_to_rgb((0.08 + i * 0.618034) % 1.0, saturation, value)
        colors.append((round(red * 255), round(green * 255), round(blue * 255)))
    return tuple(colors)
