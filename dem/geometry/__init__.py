"""Vectors, curves and places that no mechanics is in."""
