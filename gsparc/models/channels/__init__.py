"""Complex channels as a Gaussian field in closed form: leakage, direct wave and a diffuse field."""
