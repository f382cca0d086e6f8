"""The protocol: metrics, scores, baselines, summary, pictures, and the report about many runs."""
