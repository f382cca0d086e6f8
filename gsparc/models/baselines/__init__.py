"""Plain methods: means, neighbours, interpolation, processes; what every model is read against."""
