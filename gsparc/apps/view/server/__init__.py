"""The part that needs `viser`: a server, its clients, and pages that open without it."""
