"""Evaluation: ground truth, metrics, reports, baselines."""
