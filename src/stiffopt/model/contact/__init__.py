"""Arms that lean on objects: equilibria with unilateral contacts along the body."""
