"""How good a field is: scores against held-out data, baselines, folds, and error against run time."""
