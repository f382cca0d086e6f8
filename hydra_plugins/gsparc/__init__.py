"""Where Hydra looks for plugins: a launcher, and choices that no file holds."""
