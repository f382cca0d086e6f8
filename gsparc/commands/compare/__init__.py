"""Every method under the same data, splits, budgets and clock: stored cells, a table, a figure."""
