"""Contact search: broad phase, narrow phase, and the table of contacts."""

from dem.contact.search import Contacts, find_contacts, find_overrun

__all__ = ["Contacts", "find_contacts", "find_overrun"]
