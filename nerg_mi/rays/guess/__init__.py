"""What an unknown table of tracking is likely to be: the preset or the column map to import it by."""
