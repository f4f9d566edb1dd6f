"""Photo and lights → maps: starts without a network, the prior, and the solvers."""
