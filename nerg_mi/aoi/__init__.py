"""Areas of interest: measured and predicted attention, partitioned computation, and tables."""
