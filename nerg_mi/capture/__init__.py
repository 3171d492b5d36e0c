"""What was recorded: posed image sets, cameras."""
