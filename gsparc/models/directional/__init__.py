"""`model=directional_gp`: sources triangulated from directions of arrival."""
