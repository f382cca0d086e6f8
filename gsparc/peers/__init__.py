"""Other methods of the field behind the same face, from the mean image to the Gaussian process."""
