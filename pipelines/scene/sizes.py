"""Usual sizes of things as (metres, relative standard deviation, weight), with their sources.

Standards give the sizes that things are made to; how far real ones scatter around them is our judgement, wider than
the standards' own tolerances. Nothing here was fitted to a recording.
"""

from __future__ import annotations

Sizes = tuple[tuple[float, float, float], ...]

CAMERA_OVER_FLOOR: Sizes = ((1.45, 0.12, 0.75), (1.30, 0.35, 0.25))
"""Held by somebody standing: between elbow and eye. DIN 33402-2 (adults of 18 to 65, 5th percentile of women to 95th
of men): elbow 0.96 to 1.18 m, shoulder 1.26 to 1.55 m, eye 1.44 to 1.74 m, shoes 2.5 cm more (EN ISO 3411). So mostly
1.2 to 1.7 m; the second mode is for who sits or kneels, reaches up, or is a robot."""
CAMERA_OVER_TABLE = 0.70, 0.35
"""Where the lowest surface in view is a table top and not the floor: 1.45 m less a table's height."""

CEILING_OVER_FLOOR: Sizes = ((2.55, 0.08, 0.7), (2.9, 0.2, 0.3))
"""Homes: at least 2.13 m (IRC R305.1) and 2.40 m (Musterbauordnung §47), usually built at 8 to 9 feet, 2.44 to 2.74 m.
Offices (ASR A1.2): at least 2.50 m, 2.75 m from 50 m² on, 3.00 m from 100 m² on; old houses and halls are higher."""

DOOR: Sizes = ((2.02, 0.05, 0.7), (1.75, 0.2, 0.3))
"""Leaf of 1.985 m (DIN 18101), 1.981 m (United Kingdom), 80 inches = 2.032 m (United States), the frame a little more;
the second mode is for doors of which the image has cut some off."""

TABLE: Sizes = ((0.74, 0.05, 0.55), (0.43, 0.15, 0.35), (0.90, 0.05, 0.1))
"""Desks 0.74 m (EN 527-1, type C), school tables 0.76 m (EN 1729-1, size 6), dining tables 0.71 to 0.76 m; coffee
tables 0.35 to 0.50 m, which networks call tables too; worktops."""
SEAT: Sizes = ((0.45, 0.08, 0.75), (0.60, 0.3, 0.25))
"""0.46 m (EN 1729-1, size 6), 0.40 to 0.51 m (EN 1335-1), sofas 0.38 to 0.45 m; the second mode is for arm rests,
stools and things on seats."""
BED: Sizes = ((0.52, 0.18, 1.0),)
"""Upper side of the mattress: 0.43 to 0.58 m where wheelchairs shall reach it (ADA guidance), 0.40 to 0.65 m sold."""
WORKTOP: Sizes = ((0.90, 0.04, 0.8), (0.74, 0.1, 0.2))
"""0.85 to 0.90 m (EN 1116), 36 inches = 0.914 m (United States)."""
SURFACE: Sizes = ((0.43, 0.15, 0.35), (0.74, 0.05, 0.4), (0.90, 0.06, 0.25))
"""A level surface without a name: seat or coffee table, table, worktop."""

DISTANCE: Sizes = ((2.2, 0.5, 1.0),)
"""Median distance of what an indoor video sees. Depths of NYU Depth v2, a thousand rooms filmed by hand, average 2 to
3 m; a table filmed from near and a hall are a factor of two away."""

TOPS = {
    "table": ("table", TABLE),
    "desk": ("desk", TABLE),
    "coffee table": ("coffee table", ((0.43, 0.15, 1.0),)),
    "bed": ("bed", BED),
    "counter": ("worktop", WORKTOP),
    "countertop": ("worktop", WORKTOP),
    "kitchen island": ("worktop", WORKTOP),
    "chair": ("chair", SEAT),
    "armchair": ("chair", SEAT),
    "swivel chair": ("chair", SEAT),
    "sofa": ("sofa", SEAT),
    "seating": ("seat", SEAT),
}
"""Class names of networks and data sets whose upper side has a usual height: the name for people, and the heights."""
THINGS = ("door", "level surface", *dict.fromkeys(told for told, _ in TOPS.values()))
"""Sources that are counted: 2 doors, 3 chairs."""
DOORS = ("door", "double door")
FLOORS = ("floor", "rug", "carpet", "road", "earth", "ground")
FURNITURE = (*TOPS, "cabinet", "shelf", "storage", "wardrobe")
"""What a plane that is taken for the floor must not mostly be called."""
OUTDOORS = (
    "outdoors", "sky", "grass", "road", "sidewalk", "mountain", "field", "sea", "hill", "river", "skyscraper",
    "dirt track",
)  # fmt: skip
"""The group of the networks and the classes of ADE20K in it, which a room shows through its windows at most."""
