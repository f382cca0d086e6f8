"""Complex channels as a Gaussian field in closed form: leakage, direct wave, sources and a diffuse field."""
