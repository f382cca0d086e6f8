"""Several predictors of one site as one: solutions, processes,
and their weights from held-out rows.
"""
