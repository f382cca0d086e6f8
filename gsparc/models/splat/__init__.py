"""`LearnedField`: Gaussians that are rasterized,
initialised in closed form and trained by gradient.
"""
