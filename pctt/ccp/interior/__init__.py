"""Interior point methods for the cone problem."""
