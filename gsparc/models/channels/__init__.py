"""Complex channels as a Gaussian field in closed form: leakage, direct wave,
mirrors and a diffuse field.
"""
