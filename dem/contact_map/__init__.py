"""The contact map G = D' M^-1/2, from the velocities of bodies to the velocities of contacts, products with it, the
inverse mass of the bodies, and the halo of bodies of other ranks that they need."""

from dem.contact_map.halo import Halo, find_halo
from dem.contact_map.map import ContactMap
from dem.contact_map.rows import BlockRows, CompactRows, root_blocks
from dem.contact_map.turning import TurningMap

__all__ = ["BlockRows", "CompactRows", "ContactMap", "Halo", "TurningMap", "find_halo", "root_blocks"]
