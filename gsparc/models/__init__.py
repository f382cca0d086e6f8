"""What every method is (`Method`), by name, stored, loaded, timed; and the plain baselines."""
