"""How good a field is: scores against held-out data, baselines, folds, ablation, and error against run time."""
