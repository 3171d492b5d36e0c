"""Reading and writing of files: atomic output, size limits on input. Independent of what the files contain."""
