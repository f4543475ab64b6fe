"""First-order methods of the literature, kept for comparison alone: none of them was the fastest on any measured
problem (docs/problems.md). Use `apgd`, or at a tolerance of 1e-4 the Barzilai-Borwein methods."""
