"""Materials, environments and simulated captures, and the bundled example."""
