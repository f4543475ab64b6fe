"""Contact search: broad phase, narrow phase, and the table of contacts."""

from dem.contact.search import Contacts, contact_order, exceeds_margin, find_contacts, greatest_travel, velocities_about

__all__ = ["Contacts", "contact_order", "find_contacts", "exceeds_margin", "velocities_about", "greatest_travel"]
