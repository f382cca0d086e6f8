"""Every method under the same data, splits, budgets and clock: cells that are kept, a table, a figure."""
