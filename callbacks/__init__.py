"""Lightning callbacks: densify and prune, opacity reset, cost ledger, pictures."""
