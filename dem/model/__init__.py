"""The world: the state of all bodies, its pieces on the ranks, and how it is changed."""
