"""Arms in contact: equilibria with unilateral contacts along the body."""
