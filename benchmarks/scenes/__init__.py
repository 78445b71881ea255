"""Tasks among obstacles: random ones, an independent judge, a reference by IPOPT."""
