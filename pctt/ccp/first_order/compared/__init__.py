"""First-order methods of the literature that are kept for comparison alone: on no problem that was measured is one of
them the fastest (docs/problems.md). `apgd`, and at 1e-4 the Barzilai-Borwein methods, are the ones to use."""
