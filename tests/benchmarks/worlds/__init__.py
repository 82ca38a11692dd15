"""Worlds that benchmarks alone walk through; once this is imported, `make_world` knows them by name.

"corridor" repeats itself, "stairwell" has thin bars over a polished floor, "classroom" thirty desks
on a plain floor.
"""

from tests.benchmarks.worlds.classroom import classroom, classroom_walk
from tests.benchmarks.worlds.corridor import corridor_walk, ring_corridor
from tests.benchmarks.worlds.stairwell import GLOSS, stairwell, stairwell_walk
from tests.world.clip import GLOSSES, LAYOUTS, WALKS

LAYOUTS |= {"corridor": ring_corridor, "stairwell": stairwell, "classroom": classroom}
WALKS |= {"corridor": corridor_walk, "stairwell": stairwell_walk, "classroom": classroom_walk}
GLOSSES["stairwell"] = GLOSS
