"""Evaluation: metrics, thresholds, the demonstration world, pictures."""
