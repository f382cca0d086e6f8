"""A model for other programs: C, channels along a trajectory, DeepMIMO, HTTP."""
