"""Dataset rooms: one loader per layout, one schema for all."""
