"""Contact search: broad phase, narrow phase, and the table of contacts."""

from dem.contact.search import Contacts, contact_order, find_contacts, goes_beyond, velocities_about, ways_of_grains

__all__ = ["Contacts", "contact_order", "find_contacts", "goes_beyond", "velocities_about", "ways_of_grains"]
