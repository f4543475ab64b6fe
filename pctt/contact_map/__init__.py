"""The contact map G = D' M^-1/2, from the velocities of bodies to the velocities of contacts, and products with it.

There are two storage formats: frames and arms (`CompactRows`), and 3 x 6 blocks (`BlockRows`). Compiled loops over the
contacts multiply both (`compact_loops`, `block_loops`).
"""

from pctt.contact_map.ghosts import Ghosts
from pctt.contact_map.map import ContactMap
from pctt.contact_map.rows import CompactRows, block_rows

__all__ = ["CompactRows", "ContactMap", "Ghosts", "block_rows"]
