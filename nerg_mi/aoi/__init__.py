"""Areas of interest: attention on them, counted in tracked rays and predicted by a field, in parts, as tables."""
