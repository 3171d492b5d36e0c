"""What all trainings share: the state of a run, and the clock of its steps."""
