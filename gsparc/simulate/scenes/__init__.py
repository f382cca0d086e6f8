"""Places to simulate: what stands where, of what, and where the two ends may be."""
