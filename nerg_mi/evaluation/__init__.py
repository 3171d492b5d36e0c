"""Metrics, baselines and measured error."""
