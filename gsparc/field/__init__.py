"""The Gaussian field: parameters, emission, encoding, coherent terms, losses, edits,
frozen queries.
"""
